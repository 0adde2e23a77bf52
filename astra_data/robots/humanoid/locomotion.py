"""The locomotion task: walk along x without falling, with the reward of Gymnasium's Humanoid-v5."""

from dataclasses import dataclass

import numpy as np

from astra_data.core.arrays import Bools, Floats
from astra_data.robots.humanoid.model import STANDING

_QUATERNION = slice(3, 7)


@dataclass(frozen=True)
class Locomotion:
    """Rewards, starts and ends of episodes.

    Attributes:
        forward_reward: per m/s of the center of mass along x.
        healthy_reward: for every step that ends at a healthy height.
        healthy_m: range of healthy heights of the torso, outside of which the episode ends.
        effort_cost: per unit of the sum of the squared controls.
        contact_cost: per unit of the sum of the squared contact forces and torques.
        contact_cost_limit: the largest contact cost of a step.
        reset_noise: half width of the uniform noise on positions and velocities at the start.
    """

    forward_reward: float = 1.25
    healthy_reward: float = 5.0
    healthy_m: tuple[float, float] = (1.0, 2.0)
    effort_cost: float = 0.1
    contact_cost: float = 5e-7
    contact_cost_limit: float = 10.0
    reset_noise: float = 0.01

    def draw_starts(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw target states (count, 47): almost upright and at rest."""
        noise = rng.uniform(-self.reset_noise, self.reset_noise, (count, len(STANDING)))
        state = np.array(STANDING) + noise
        state[:, _QUATERNION] /= np.linalg.norm(state[:, _QUATERNION], axis=1, keepdims=True)
        return state

    def healthy(self, height: Floats) -> Bools:
        """Return which torso heights (B,) in m are healthy."""
        low, high = self.healthy_m
        return np.asarray((height > low) & (height < high))

    def reward(self, velocity: Floats, healthy: Bools, effort: Floats, contact: Floats) -> Floats:
        """Return the reward (B,) of a step.

        Args:
            velocity: of the center of mass along x, (B,) in m/s.
            healthy: after the step, (B,).
            effort: sum of the squared controls, (B,).
            contact: sum of the squared contact forces and torques of all bodies, (B,).
        """
        cost = self.effort_cost * effort
        cost = cost + np.minimum(self.contact_cost * contact, self.contact_cost_limit)
        return np.asarray(self.forward_reward * velocity + self.healthy_reward * healthy - cost)
