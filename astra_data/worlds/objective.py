"""Objectives of tasks, on abstract states: the same in target and simulator, so rewards compare; scores."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.lazy import Tensor, torch


@dataclass(frozen=True)
class Score:
    """A measure of episodes; the larger, the better."""

    measure: str  # its name in evaluation.json, which has one number per episode
    title: str  # of a table's column
    quantity: str  # name of its mean over episodes, within a sentence
    digits: int  # shown behind the decimal point
    limit: float | None = None  # the largest possible value, at which axes end; None where there is none

    def text(self, value: float) -> str:
        """Return a value with its digits."""
        return f"{value:.{self.digits}f}"


SUCCESS = Score("success", "success", "success rate", 2, limit=1.0)
SURVIVED_STEPS = Score("steps", "survived steps", "number of survived steps", 0)
RETURN = Score("return", "return", "return", 1)

NO_LIMIT = 2.0  # of the length of velocity commands: longer than any of ±1 on two axes


@dataclass(frozen=True)
class Objective(ABC):
    """Starts, goals, observations, rewards and ends of a task; states are abstract ones, (..., X).

    Attributes:
        horizon: steps until an episode is cut off.
        ends_at_walls: whether touching a wall is a failure, which ends an episode.
        is_lasting: whether success is to last to the horizon, not to reach something before.
        action_size: A. goal_size: G, 0 where all episodes have the same goal.
        maze: that it happens in, where there is one.

    Example:
        >>> import numpy as np
        >>> from astra_data import TASKS
        >>> objective = TASKS["antmaze-umaze"].objective
        >>> objective.horizon, objective.draw_goals(np.random.default_rng(0), 3).shape  # (count, G)
        (700, (3, 2))
    """

    is_lasting: ClassVar[bool] = False
    action_size: ClassVar[int]
    goal_size: ClassVar[int] = 0

    horizon: int = field(kw_only=True)
    success_reward: float = field(default=10.0, kw_only=True)
    failure_reward: float = field(default=-10.0, kw_only=True)
    ends_at_walls: bool = field(default=False, kw_only=True)

    @property
    def scores(self) -> tuple[Score, ...]:
        """The scores by which rows are compared, as in the paper, the headline first."""
        return (SURVIVED_STEPS, RETURN) if self.is_lasting else (SUCCESS,)

    @abstractmethod
    def draw_starts(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw states (count, X), at rest, where the task starts."""

    def draw_goals(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw goals (count, G); by default there is nothing to draw, G = 0."""
        return np.empty((count, 0))

    def observe(self, state: Tensor, goal: Tensor) -> Tensor:
        """Assemble the observation of states (..., X) and goals (..., G), each part about 1; by default as they are."""
        return torch.cat([state, goal], dim=-1)

    def limit_command(self, action: Tensor, limit: float) -> Tensor:
        """Clip actions (..., A) to ±1; `limit` has no effect on actions that are no velocities."""
        return action.clamp(-1.0, 1.0)

    @abstractmethod
    def reached(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return in which states (B, X) the goals (B, G) are reached, (B,) bool."""

    def places(self, state: Tensor) -> Tensor:
        """Return x and y in m of the K bodies that move in the plane, (..., 2 K); by default K = 0."""
        return state[..., :0]

    def succeeded(self, reached: Tensor, failed: Tensor, step: int) -> Tensor:
        """Return which episodes (B,) succeed in their `step` from 1, in which they `reached` goals, or `failed`."""
        return ~failed if self.is_lasting and step >= self.horizon else reached

    def missed(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return in which states (B, X) the goals (B, G) are out of reach, (B,) bool: by default none."""
        return torch.zeros(len(state), dtype=torch.bool, device=state.device)

    def decided(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return in which states (B, X) the goals (B, G) are reached or out of reach, (B,) bool."""
        return self.reached(state, goal) | self.missed(state, goal)

    @abstractmethod
    def reward(self, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
        """Return the reward (B,) of a step between states (B, X), a failure where `failed` (B,)."""
