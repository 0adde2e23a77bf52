"""The objective of walking on each abstraction of the humanoid: the target's reward without its costs.

All reward forward velocity and staying up, as `Locomotion` does; the costs of effort and contact forces,
which are small in the target, are left out. There is no goal to reach: an episode that lasts to the horizon
without a fall succeeds.
"""

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import normalized
from astra_data.robots.humanoid.abstraction import (
    humanoid_to_extended_kinematics,
    humanoid_to_kinematics,
    humanoid_to_walker2d,
)
from astra_data.robots.humanoid.locomotion import Locomotion
from astra_data.robots.humanoid.model import COMMANDED, JOINTS, STANDING, TIMESTEP_S
from astra_data.robots.humanoid.skeleton import mass_and_feet, mass_velocity
from astra_data.robots.humanoid.spread import (
    JOINT_RATES_RAD_S,
    JOINTS_RAD,
    LEAN_RAD,
    POSITION_M,
    SPIN_RAD_S,
    VELOCITY_M_S,
)
from astra_data.worlds.objective import Objective

_COUNT = len(JOINTS)
_LEGS_RAD = tuple(JOINTS_RAD[joint] for joint in COMMANDED)
_LEG_RATES_RAD_S = tuple(JOINT_RATES_RAD_S[joint] for joint in COMMANDED)


@dataclass(frozen=True)
class Walking(Objective):
    """Walk along x and do not fall; there is no goal.

    Attributes:
        locomotion: rewards and starts of the target.
        failure_reward: minus the reward for staying up, which a step that ends in a fall does not get.
    """

    action_size = len(COMMANDED)
    is_lasting = True
    spread: ClassVar[tuple[float, ...]]
    """Typical deviation of each entry of a state from standing, (X,)."""

    locomotion: Locomotion = field(default_factory=Locomotion)
    failure_reward: float = field(default=-5.0, kw_only=True)

    @abstractmethod
    def abstracted(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return φ of target states (count, 47), (count, X)."""

    def observe(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return the deviations of states (..., X) from standing, in spreads and clipped to ±5, (..., X)."""
        return normalized(state, state.new_tensor(self._standing), state.new_tensor(self.spread))

    @cached_property
    def _standing(self) -> NDArray[np.float64]:
        return self.abstracted(np.array(STANDING))

    @abstractmethod
    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the body's forward velocity in a step between states (B, X), (B,) in m/s."""

    def draw_starts(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw states (count, X) as the target does: almost upright and at rest."""
        return self.abstracted(self.locomotion.draw_starts(rng, count))

    def reached(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return False for all states (B, X), (B,): there is no goal to reach."""
        return torch.zeros(len(state), dtype=torch.bool, device=state.device)

    def reward(self, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
        """Return the reward (B,) of a step between states (B, X), a fall where `failed` (B,)."""
        task = self.locomotion
        return (
            task.forward_reward * self.velocity(before, after)
            + task.healthy_reward
            + self.failure_reward * failed
        )


@dataclass(frozen=True)
class PlanarWalking(Walking):
    """Walking of the planar walker, states (..., 15); outside of the healthy heights it has fallen."""

    spread = (
        *(POSITION_M, LEAN_RAD, *_LEGS_RAD),
        *(VELOCITY_M_S, VELOCITY_M_S, SPIN_RAD_S, *_LEG_RATES_RAD_S),
        *(1.0, 1.0),
    )

    def abstracted(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return φ of target states (count, 47), (count, 15)."""
        return humanoid_to_walker2d(state)

    def missed(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return which torsos of states (B, 15) are outside of the healthy heights, (B,) bool."""
        low, high = self.locomotion.healthy_m
        return ~((state[:, 0] > low) & (state[:, 0] < high))

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the forward velocity of the center of mass after the step, with stiff arms, (B,) in m/s."""
        joints = after.new_zeros(2, len(after), _COUNT)
        joints[..., COMMANDED] = torch.stack([after[:, 2:6], after[:, 9:13]])
        mass, _ = mass_and_feet(joints[0])
        swept = mass_velocity(*joints)
        pitch, pitch_rate = after[:, 1], after[:, 8]
        forward, up = swept[:, 0] + pitch_rate * mass[:, 2], swept[:, 2] - pitch_rate * mass[:, 0]
        return after[:, 6] + torch.cos(pitch) * forward + torch.sin(pitch) * up


@dataclass(frozen=True)
class JointWalking(Walking):
    """Walking of the joints alone, states (..., 34); they show no falls, so every episode succeeds."""

    spread = (*JOINTS_RAD, *JOINT_RATES_RAD_S)

    def abstracted(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return φ of target states (count, 47), (count, 34)."""
        return humanoid_to_kinematics(state)

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the velocity of a level torso over its lower foot, which does not slip, (B,) in m/s."""
        feet, later = (mass_and_feet(state[:, :_COUNT])[1] for state in (before, after))
        rows = torch.arange(len(feet), device=feet.device)
        lower = feet[..., 2].argmin(dim=-1)
        return (feet[rows, lower, 0] - later[rows, lower, 0]) / TIMESTEP_S


@dataclass(frozen=True)
class MassWalking(Walking):
    """Walking of joints, center of mass and the torso's lean, states (..., 46).

    Attributes:
        lowest_mass_m: a humanoid whose center of mass is lower than this has fallen, on average two steps
            before the target's episode ends; standing it is 0.9 m high.
    """

    spread = (
        *JointWalking.spread,
        *([POSITION_M] * 3 + [VELOCITY_M_S] * 3 + [LEAN_RAD] * 3 + [SPIN_RAD_S] * 3),
    )

    lowest_mass_m: float = 0.65

    def abstracted(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return φ of target states (count, 47), (count, 46)."""
        return humanoid_to_extended_kinematics(state)

    def missed(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return which centers of mass of states (B, 46) are too low, (B,) bool."""
        return ~(state[:, 2 * _COUNT + 2] >= self.lowest_mass_m)

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the velocity of the center of mass along the heading after the step, (B,) in m/s."""
        return after[:, 2 * _COUNT + 3]
