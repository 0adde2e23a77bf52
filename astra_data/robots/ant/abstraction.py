"""φ of the ant, and the part of its state that it drops.

φ maps target states (..., S) to abstract states (..., X), numpy in, numpy out, torch in, torch out.
"""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

_PLANAR = [0, 1, 15, 16]
_REST = [entry for entry in range(29) if entry not in _PLANAR]
_JOINT_RATES = slice(-8, None)


def ant_to_point_mass[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep the planar position and velocity of an ant's state: (..., 29) to [x, y, vx, vy] (..., 4).

    Position in m and velocity in m/s, both of the torso in the world frame. Dropped: height, orientation,
    all joints, and every rate but the two planar ones.
    """
    return state[..., _PLANAR]


def ant_beyond_point_mass(state: Tensor) -> Tensor:
    """Return the part of an ant's state that `ant_to_point_mass` drops: (..., 29) to (..., 25).

    In the order of the state and in SI units, but for joint rates, which reach 10 rad/s: a fifth of those.
    """
    rest = state[..., _REST]
    rest[..., _JOINT_RATES] *= 0.2
    return rest
