"""Rotations of bodies in space; motions of the planar frame, and what they do to the values of a column."""

from dataclasses import dataclass

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.dataset.columns import Array, Column


def wrapped[Angle: (Floats, Tensor)](angle: Angle) -> Angle:
    """Return `angle` in rad, any shape, in [-π, π)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True)
class PlanarMap:
    """A rigid motion of the plane: p ↦ R(rotation) p + shift."""

    rotation_rad: float = 0.0
    shift_m: tuple[float, float] = (0.0, 0.0)

    def vectors(self, values: Floats) -> Floats:
        """Turn velocities and other differences of positions (..., 2), in the world's frame."""
        x, y = values[..., 0], values[..., 1]
        cos, sin = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)

    def positions(self, values: Floats) -> Floats:
        """Move positions (..., 2) in m."""
        return np.asarray(self.vectors(values) + np.array(self.shift_m))

    def headings(self, values: Floats) -> Floats:
        """Turn angles (...) from the world's x axis in rad; the result is in [-π, π)."""
        return wrapped(values + self.rotation_rad)

    def quaternions(self, values: Floats) -> Floats:
        """Turn body-to-world rotations (..., 4), unit quaternions (w, x, y, z)."""
        w, x, y, z = np.moveaxis(values, -1, 0)
        cos, sin = np.cos(self.rotation_rad / 2), np.sin(self.rotation_rad / 2)
        turned = [cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w]
        return np.stack(turned, axis=-1)

    def of_column(self, column: Column, values: Array) -> Array:
        """Move the values (T,) or (T, size) of `column` by the roles of its entries; computed in float64."""
        if not column.roles:
            raise BadInputError(f"column {column.name} has no roles: expected one for each of its values")
        before: Floats = values.reshape(len(values), column.size).astype(np.float64)
        after = before.copy()
        for role, group in column.roles:
            if role == "heading":
                after[:, group] = self.headings(before[:, group])
            elif role == "quaternion":
                after[:, group] = self.quaternions(before[:, group])
            elif role != "invariant":
                act = self.positions if role == "position" else self.vectors
                after[:, group] = act(before[:, group])
        return after.astype(values.dtype).reshape(values.shape)


def turned(vector: Tensor, angle_rad: Tensor) -> Tensor:
    """Turn planar vectors (..., 2) to the left by angles (...)."""
    cos, sin = angle_rad.cos(), angle_rad.sin()
    x, y = vector.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)


def rotation_matrix(quaternion: Floats) -> Floats:
    """Return body-to-world rotations (B, 3, 3) of unit quaternions (B, 4) wxyz."""
    return np.asarray(rotation(torch.from_numpy(quaternion)).numpy())


def rotation(quaternion: Tensor) -> Tensor:
    """Return body-to-world rotations (..., 3, 3) of unit quaternions (..., 4) wxyz."""
    w, x, y, z = quaternion.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))  # type: ignore[no-any-return]
