"""φ of the NAO, with and without a ball, and the part of its state that it drops.

φ maps target states (..., S) to abstract states (..., X), numpy in, numpy out, torch in, torch out.
"""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

_PLANAR = [0, 1, 4, 5]
STATE_SIZE = 29
"""Estimated x, y, cos and sin of the heading, planned velocity x, y in the world, angles (11) of the legs'
joints, gyroscope (3), tilt (2), load (2) of the feet, phase (2) of the step, planned velocity (3) in the
body. The estimate of the ball follows, if there is one."""
_BALL = [STATE_SIZE + entry for entry in range(4)]


def nao_to_point_mass[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep a NAO's estimated position and its planned velocity: (..., S) to [x, y, vx, vy] (..., 4).

    In m and m/s, in the world frame. Dropped: the heading, the legs' joints, how the torso sways, the feet's
    load, the phase of the step. The error of the estimates is not part of the state.
    """
    return state[..., _PLANAR]


def nao_to_ball_agent[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep what `nao_to_point_mass` does, and the estimate of the ball: (..., 34) to (..., 8).

    The ball's position in m and velocity in m/s in the world frame. Dropped besides: the time since the ball
    was last seen.
    """
    return state[..., _PLANAR + _BALL]


def nao_beyond(state: Tensor) -> Tensor:
    """Return the part of a NAO's state that φ drops: (..., 29) to (..., 25), with a ball 34 to 26."""
    rest = [entry for entry in range(state.shape[-1]) if entry not in _PLANAR + _BALL]
    return state[..., rest]
