"""What walking asks for, on what each abstraction of the humanoid knows: the target's reward, without costs.

All pay for going forward and for staying up, as `Locomotion` does; none knows of effort and contact forces,
which cost the target little. Nothing is to be reached: who lasts to the horizon without falling succeeds.

Under random commands the pay for a step differs from the target's, costs aside, by 0.02 (root mean square)
where the centre of mass is known, by 0.6 in the plane, and by 2 of the joints alone, whose pay has nothing to
do with the target's there: the level torso that it goes by is what such a body does not have.
"""

from abc import abstractmethod
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.humanoid.abstraction import (
    humanoid_to_extended_kinematics,
    humanoid_to_kinematics,
    humanoid_to_walker2d,
)
from astra_data.humanoid.locomotion import Locomotion
from astra_data.humanoid.model import COMMANDED, JOINTS, TIMESTEP_S
from astra_data.humanoid.skeleton import mass_and_feet, mass_velocity
from astra_data.objective import Objective

_COUNT = len(JOINTS)
_RATE = 0.2
"""Factor on angular rates, which reach 10 rad/s."""


@dataclass(frozen=True)
class Walking(Objective):
    """Walk along x and do not fall; there is no goal.

    Attributes:
        locomotion: how the target pays and where it starts.
        failure_reward: what a step that ends in a fall lacks, which is the reward for staying up.
    """

    action_size = len(COMMANDED)
    goal_size = 0
    is_lasting = True

    locomotion: Locomotion = field(default_factory=Locomotion)
    failure_reward: float = field(default=-5.0, kw_only=True)

    @abstractmethod
    def abstracted(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return φ of target states (count, 47), (count, X)."""

    @abstractmethod
    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return how fast the body went forward in a step between states (B, X), (B,) in m/s."""

    def draw_starts(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw states (count, X) as the target does: almost upright and at rest."""
        return self.abstracted(self.locomotion.draw_starts(rng, count))

    def draw_goals(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Return no goals, (count, 0)."""
        return np.empty((count, 0))

    def reached(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return that none of the states (B, X) ends the task well, (B,)."""
        return torch.zeros(len(state), dtype=torch.bool, device=state.device)

    def reward(self, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
        """Return the reward (B,) of a step between states (B, X), which perhaps ended in a fall (B,)."""
        task = self.locomotion
        return (
            task.forward_reward * self.velocity(before, after)
            + task.healthy_reward
            + self.failure_reward * failed
        )


@dataclass(frozen=True)
class PlanarWalking(Walking):
    """Of the planar walker, states (..., 15); it falls as the target does: at no healthy height."""

    def abstracted(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return φ of target states (count, 47), (count, 15)."""
        return humanoid_to_walker2d(state)

    def observe(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return the state (..., 15), rates scaled."""
        return torch.cat([state[..., :8], _RATE * state[..., 8:13], state[..., 13:]], dim=-1)

    def missed(self, state: Tensor, goal: Tensor) -> Tensor:
        """Tell which torsos (B,) of states (B, 15) are at no healthy height."""
        low, high = self.locomotion.healthy_m
        return ~((state[:, 0] > low) & (state[:, 0] < high))

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the centre of mass's velocity along x after the step, (B,) in m/s, trunk and arms stiff."""
        joints = after.new_zeros(2, len(after), _COUNT)
        joints[..., COMMANDED] = torch.stack([after[:, 2:6], after[:, 9:13]])
        mass, _ = mass_and_feet(joints[0])
        swept = mass_velocity(*joints)
        pitch, pitch_rate = after[:, 1], after[:, 8]
        forward, up = swept[:, 0] + pitch_rate * mass[:, 2], swept[:, 2] - pitch_rate * mass[:, 0]
        return after[:, 6] + torch.cos(pitch) * forward + torch.sin(pitch) * up


@dataclass(frozen=True)
class JointWalking(Walking):
    """Of the joints alone, states (..., 34): nothing in them tells a fall, so every episode succeeds."""

    def abstracted(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return φ of target states (count, 47), (count, 34)."""
        return humanoid_to_kinematics(state)

    def observe(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return the state (..., 34), rates scaled."""
        return torch.cat([state[..., :_COUNT], _RATE * state[..., _COUNT:]], dim=-1)

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return how fast a level torso goes over its lower foot, which does not slip, (B,) in m/s."""
        feet, later = (mass_and_feet(state[:, :_COUNT])[1] for state in (before, after))
        rows = torch.arange(len(feet), device=feet.device)
        lower = feet[..., 2].argmin(dim=-1)
        return (feet[rows, lower, 0] - later[rows, lower, 0]) / TIMESTEP_S


@dataclass(frozen=True)
class MassWalking(Walking):
    """Of joints, centre of mass and how the torso leans, states (..., 46).

    Attributes:
        lowest_mass_m: a centre of mass lower than this has fallen, two steps before the target says so on
            average; that of one who stands is 0.9 m high.
    """

    lowest_mass_m: float = 0.65

    def abstracted(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return φ of target states (count, 47), (count, 46)."""
        return humanoid_to_extended_kinematics(state)

    def observe(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return the state (..., 46), rates scaled."""
        joints, rates, body, spin = state.split((_COUNT, _COUNT, 9, 3), dim=-1)
        return torch.cat([joints, _RATE * rates, body, _RATE * spin], dim=-1)

    def missed(self, state: Tensor, goal: Tensor) -> Tensor:
        """Tell which centres of mass (B,) of states (B, 46) have fallen."""
        return ~(state[:, 2 * _COUNT + 2] >= self.lowest_mass_m)

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the velocity of the centre of mass along x after the step, (B,) in m/s."""
        return after[:, 2 * _COUNT + 3]
