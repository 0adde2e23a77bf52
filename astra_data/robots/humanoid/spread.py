"""Typical deviations of a walking humanoid's state from standing: they scale networks' inputs to about 1."""

from torch import Tensor

from astra_data.core.arrays import normalized
from astra_data.robots.humanoid.model import COMMANDED, JOINTS, STANDING

JOINTS_RAD = tuple(0.3 if joint in COMMANDED else 0.025 for joint in range(len(JOINTS)))
JOINT_RATES_RAD_S = tuple(2.5 if joint in COMMANDED else 0.6 for joint in range(len(JOINTS)))
POSITION_M = 0.07
VELOCITY_M_S = 0.3
LEAN_RAD = 0.1
SPIN_RAD_S = 1.0

_QUATERNION = 0.2
_STATE = (
    *([POSITION_M] * 3 + [_QUATERNION] * 4),
    *JOINTS_RAD,
    *([VELOCITY_M_S] * 3 + [SPIN_RAD_S] * 3),
    *JOINT_RATES_RAD_S,
)


def in_spreads(state: Tensor) -> Tensor:
    """Return the deviations of target states (..., 47) from standing, clipped at 5 spreads, (..., 47)."""
    return normalized(state, state.new_tensor(STANDING), state.new_tensor(_STATE))
