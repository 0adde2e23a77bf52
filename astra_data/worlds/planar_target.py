"""What simulated targets with an objective in a maze have in common: starts, goals, and how steps end."""

from abc import ABC, abstractmethod

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Bools, Floats
from astra_data.worlds.batched import Step
from astra_data.worlds.objective import PlanarObjective


class PlanarTarget(ABC):
    """B robots in a maze. An observation (B, O) is the state, then the goal.

    Success, falls, misses and, where the objective says so, walls end an episode.

    Attributes:
        objective: maze, goal and reward.
        goal: (B, 2) float32. failed: (B,) bool, failed in the last step.
    """

    def __init__(self, objective: PlanarObjective, num_envs: int, *, start_anywhere: bool = False) -> None:
        """Set no goals yet.

        Args:
            objective: maze, goal and reward.
            num_envs: B.
            start_anywhere: start anywhere in the free space, not at the task's start (for collecting).
        """
        self.objective, self.num_envs, self.start_anywhere = objective, num_envs, start_anywhere
        self.goal = torch.zeros(num_envs, 2)
        self.failed = torch.zeros(num_envs, dtype=torch.bool)

    @property
    @abstractmethod
    def state(self) -> Tensor:
        """The full target states, (B, S) float32."""

    @property
    @abstractmethod
    def wall_contact(self) -> Tensor:
        """Which robots touched a wall in their last step, (B,) bool."""

    def reseed(self, seed: int) -> None:
        """Restart the random numbers at `seed`."""
        self._rng = np.random.default_rng(seed)

    def _start(self, rows: NDArray[np.intp]) -> Floats:
        """Return the abstract states (n, X) at which the robots `rows` (n,) start."""
        objective = self.objective
        draw = objective.draw_anywhere if self.start_anywhere else objective.draw_starts
        return draw(self._rng, len(rows))

    def _aim(self, rows: NDArray[np.intp]) -> None:
        """Draw new goals for the robots `rows` (n,)."""
        self.goal[rows] = torch.from_numpy(self.objective.draw_goals(self._rng, len(rows))).float()

    def _judged(self, before: Tensor, after: Tensor, fallen: Bools) -> Step:
        """Return the outcome of a step between states (B, 2 or more) that begin with true positions.

        Who reaches the goal has not failed, `fallen` (B,) or not.
        """
        success = self.objective.reached(after, self.goal)
        failed = torch.from_numpy(fallen) | self.objective.missed(after, self.goal)
        if self.objective.ends_at_walls:
            failed |= self.wall_contact
        self.failed = failed & ~success
        return Step(
            observation=self._observe(),
            reward=self.objective.reward(before, after, self.goal, self.failed),
            terminated=success | self.failed,
            success=success,
        )

    def _observe(self) -> Tensor:
        return torch.cat([self.state, self.goal], dim=-1)
