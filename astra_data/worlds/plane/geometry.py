"""Changes of the planar frame: rotation, shift and mirroring, and what they do to the values of a column.

A robot on a level floor does not feel where it is and which way it faces. Mirroring also swaps its left and
its right; a robot that is its own mirror image does not feel that either.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Array, Column

Floats = NDArray[np.float64]


def wrapped(angle: Floats) -> Floats:
    """Return `angle` in rad, any shape, in [-π, π)."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


@dataclass(frozen=True)
class PlanarMap:
    """A rigid map of the plane: p ↦ R(rotation) M p + shift, where M turns y into -y if it reflects.

    Attributes:
        rotation_rad: angle of R, counterclockwise.
        shift_m: (x, y).
        reflected: whether M is there.
    """

    rotation_rad: float = 0.0
    shift_m: tuple[float, float] = (0.0, 0.0)
    reflected: bool = False

    def inverse(self) -> "PlanarMap":
        """Return the map that undoes this one."""
        back = PlanarMap(
            self.rotation_rad if self.reflected else -self.rotation_rad, reflected=self.reflected
        )
        x, y = back.vectors(-np.array(self.shift_m))
        return PlanarMap(back.rotation_rad, (float(x), float(y)), self.reflected)

    def __matmul__(self, first: "PlanarMap") -> "PlanarMap":
        """Return the map that does `first`, then this one."""
        x, y = self.positions(np.array(first.shift_m))
        turned = -first.rotation_rad if self.reflected else first.rotation_rad
        rotation = float(wrapped(np.asarray(self.rotation_rad + turned)))
        return PlanarMap(rotation, (float(x), float(y)), self.reflected != first.reflected)

    def vectors(self, values: Floats) -> Floats:
        """Turn velocities and other differences of positions (..., 2), in the world's frame."""
        x, y = values[..., 0], -values[..., 1] if self.reflected else values[..., 1]
        cos, sin = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)

    def positions(self, values: Floats) -> Floats:
        """Move positions (..., 2) in m."""
        return np.asarray(self.vectors(values) + np.array(self.shift_m))

    def headings(self, values: Floats) -> Floats:
        """Turn angles (...) from the world's x axis in rad; the result is in [-π, π)."""
        return wrapped((-values if self.reflected else values) + self.rotation_rad)

    def quaternions(self, values: Floats) -> Floats:
        """Turn body-to-world rotations (..., 4), unit quaternions (w, x, y, z).

        The image of a rotation Q is R M Q M: the body is mirrored too, in its own xz plane.
        """
        w, x, y, z = np.moveaxis(values, -1, 0)
        if self.reflected:
            x, z = -x, -z
        cos, sin = np.cos(self.rotation_rad / 2), np.sin(self.rotation_rad / 2)
        turned = [cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w]
        return np.stack(turned, axis=-1)

    def of_column(self, column: Column, values: Array) -> Array:
        """Move the values (T,) or (T, size) of `column` as its roles say; computed in float64.

        Raises:
            BadInputError: the column does not say how; see `faults`.
        """
        faults = self.faults(column)
        if faults:
            raise BadInputError(f"{'; '.join(faults)}.")
        before: Floats = values.reshape(len(values), column.size).astype(np.float64)
        if self.reflected and column.mirror is not None:
            source, sign = column.mirror
            before = before[:, source] * sign
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

    def faults(self, column: Column) -> list[str]:
        """List what `column` would have to say to be moved by this map; empty if it says all."""
        if not column.roles:
            return [f"{column.name}: its roles are not told"]
        if self.reflected and column.mirror is None:
            return [f"{column.name}: the mirror image of its invariant values is not told"]
        return []


def turned(vector: Tensor, angle_rad: Tensor) -> Tensor:
    """Turn planar vectors (..., 2) to the left by angles (...)."""
    cos, sin = angle_rad.cos(), angle_rad.sin()
    x, y = vector.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)
