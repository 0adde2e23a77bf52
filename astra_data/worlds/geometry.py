"""Rotations of bodies in space."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def rotation_matrix(quaternion: Floats) -> Floats:
    """Return body-to-world rotations (B, 3, 3) of unit quaternions (B, 4) wxyz."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
