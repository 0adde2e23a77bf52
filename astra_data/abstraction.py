"""φ: one pure function for each pair of target environment and abstract simulator.

Each maps target states (..., S) to abstract states (..., X), numpy in, numpy out, torch in, torch out.
"""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

_ANT_PLANAR = [0, 1, 15, 16]


def ant_to_point_mass[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep the planar position and velocity of an ant's state: (..., 29) to [x, y, vx, vy] (..., 4).

    Position in m and velocity in m/s, both of the torso in the world frame. Dropped: height, orientation,
    all joints, and every rate but the two planar ones.
    """
    return state[..., _ANT_PLANAR]
