"""φ: one pure function for each pair of target environment and abstract simulator, and what each drops.

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
    """Return what `ant_to_point_mass` drops of an ant's state: (..., 29) to (..., 25).

    In the order of the state; a fifth of the joint rates, which reach 10 rad/s, and all else in SI units.
    """
    rest = state[..., _ANT_REST]
    rest[..., _JOINT_RATES] *= 0.2
    return rest


_NAO_PLANAR = [0, 1, 4, 5]
NAO_STATE_SIZE = 29
"""Of a NAO's state; what it believes of its ball follows."""
_BALL = [NAO_STATE_SIZE + entry for entry in range(4)]


def nao_to_point_mass[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep where a NAO believes it is, and how it walks: (..., S) to [x, y, vx, vy] (..., 4).

    Position in m and planned velocity in m/s, in the world frame. Dropped: the heading, the legs' joints, how
    the torso sways, the feet's load, where in its step the robot is; and how far its beliefs are from the
    truth, which it does not know.
    """
    return state[..., _NAO_PLANAR]


def nao_to_ball_agent[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep what `nao_to_point_mass` does, and where it believes the ball is: (..., 34) to (..., 8).

    The ball's position in m and velocity in m/s in the world frame. Dropped besides: since when the ball has
    not been seen.
    """
    return state[..., _NAO_PLANAR + _BALL]


def nao_beyond(state: Tensor) -> Tensor:
    """Return what φ drops of a NAO's state, without or with a ball: (..., 29) to (..., 25), 34 to 26."""
    rest = [entry for entry in range(state.shape[-1]) if entry not in _NAO_PLANAR + _BALL]
    return state[..., rest]
