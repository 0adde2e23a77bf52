"""φ of ants and NAOs, one function per abstract simulator, and the part of target states that it drops.

φ maps target states (..., S) to abstract states (..., X), numpy in, numpy out, torch in, torch out.
"""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

_ANT_PLANAR = [0, 1, 15, 16]
_ANT_REST = [entry for entry in range(29) if entry not in _ANT_PLANAR]
_JOINT_RATES = slice(-8, None)


def ant_to_point_mass[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep the planar position and velocity of an ant's state: (..., 29) to [x, y, vx, vy] (..., 4).

    Position in m and velocity in m/s, both of the torso in the world frame. Dropped: height, orientation,
    all joints, and every rate but the two planar ones.
    """
    return state[..., _ANT_PLANAR]


def ant_beyond_point_mass(state: Tensor) -> Tensor:
    """Return the part of an ant's state that `ant_to_point_mass` drops: (..., 29) to (..., 25).

    In the order of the state and in SI units, but for joint rates, which reach 10 rad/s: a fifth of those.
    """
    rest = state[..., _ANT_REST]
    rest[..., _JOINT_RATES] *= 0.2
    return rest


_NAO_PLANAR = [0, 1, 4, 5]
NAO_STATE_SIZE = 29
"""Size of a NAO's state without a ball; its estimate of the ball follows."""
_BALL = [NAO_STATE_SIZE + entry for entry in range(4)]


def nao_to_point_mass[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep a NAO's estimated position and its planned velocity: (..., S) to [x, y, vx, vy] (..., 4).

    In m and m/s, in the world frame. Dropped: the heading, the legs' joints, how the torso sways, the feet's
    load, the phase of the step. The error of the estimates is not part of the state.
    """
    return state[..., _NAO_PLANAR]


def nao_to_ball_agent[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep what `nao_to_point_mass` does, and the estimate of the ball: (..., 34) to (..., 8).

    The ball's position in m and velocity in m/s in the world frame. Dropped besides: the time since the ball
    was last seen.
    """
    return state[..., _NAO_PLANAR + _BALL]


def nao_beyond(state: Tensor) -> Tensor:
    """Return the part of a NAO's state that φ drops: (..., 29) to (..., 25), with a ball 34 to 26."""
    rest = [entry for entry in range(state.shape[-1]) if entry not in _NAO_PLANAR + _BALL]
    return state[..., rest]
