"""Rotations of bodies in space."""

import numpy as np
import torch
from torch import Tensor

from astra_data.core.arrays import Floats


def rotation_matrix(quaternion: Floats) -> Floats:
    """Return body-to-world rotations (B, 3, 3) of unit quaternions (B, 4) wxyz."""
    return np.moveaxis(np.array(_entries(*quaternion.T)).reshape(3, 3, -1), -1, 0)


def rotation(quaternion: Tensor) -> Tensor:
    """Return body-to-world rotations (..., 3, 3) of unit quaternions (..., 4) wxyz."""
    rows: Tensor = torch.stack(_entries(*quaternion.unbind(-1)), dim=-1).unflatten(-1, (3, 3))
    return rows


def _entries[Array: (Floats, Tensor)](w: Array, x: Array, y: Array, z: Array) -> list[Array]:
    return [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
