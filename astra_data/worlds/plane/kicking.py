"""The kicking objective: get the ball into the goal.

The paper prints no reward. Ours: meters by which the ball comes closer to the goal, plus half the meters by
which the robot comes closer to the point behind the ball, +10 for a goal, -10 for a ball that leaves the
field elsewhere and for falling. Lines and goal are those of RoboCup's Standard Platform League, at smaller
distances.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.worlds.objective import PlanarObjective

_NEAR_M = (0.18, 0.5)
"""Distances from the ball at which recorded episodes begin; a foot reaches as far as the first."""


@dataclass(frozen=True)
class Kicking(PlanarObjective):
    """Get the ball into the goal at the right end of `maze`, an empty field, within `horizon` steps.

    Abstract states begin with robot position and velocity, ball position and velocity, (..., 8). The goal
    (..., 2) is the middle of the goal line. Actions (..., 3) end with whether to kick.

    Attributes:
        goal_line_m: x of the goal line. goal_half_width_m: of the goal on it.
        side_line_m: |y| of the side lines. back_line_m: x of the line behind.
        ball_x_m, ball_y_m: ranges of the ball's position at the start.
        distance_m: of the robot from the ball at the start.
        behind_m: distance from the ball of the point behind it that the shaping reward leads to.
    """

    action_size = 3

    goal_line_m: float = 1.5
    goal_half_width_m: float = 0.75
    side_line_m: float = 2.0
    back_line_m: float = -2.0
    ball_x_m: tuple[float, float] = (-0.5, 0.0)
    ball_y_m: tuple[float, float] = (-0.6, 0.6)
    distance_m: tuple[float, float] = (0.4, 1.0)
    behind_m: float = 0.2

    def draw_starts(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw states (count, 8) at rest: the ball in front of the goal, the robot around it."""
        ball = np.stack([rng.uniform(*self.ball_x_m, count), rng.uniform(*self.ball_y_m, count)], axis=1)
        angle, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(*self.distance_m, count)
        robot = ball + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        rest = np.zeros_like(robot)
        return np.concatenate([robot, rest, ball, rest], axis=1)

    def draw_anywhere(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw states (count, 8) at rest with the robot near its ball, which it rarely meets from afar."""
        return replace(self, distance_m=_NEAR_M).draw_starts(rng, count)

    def draw_goals(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Return the middle of the goal line, (count, 2)."""
        return np.tile([self.goal_line_m, 0.0], (count, 1))

    def observe(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return positions, velocities, and vectors to the ball, the goal and behind the ball, (..., 14)."""
        robot, velocity, ball, rolling = state.split(2, dim=-1)
        behind = self._behind(ball, goal) - robot
        places = [robot / 2, ball / 2, (goal - ball) / 2]
        return torch.cat([*places, 4 * velocity, rolling, 4 * (ball - robot), 4 * behind], dim=-1)

    def _behind(self, ball: Tensor, goal: Tensor) -> Tensor:
        to_goal = goal - ball
        back: Tensor = self.behind_m * to_goal / to_goal.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        return ball - back

    def places(self, state: Tensor) -> Tensor:
        """Return the positions of robot and ball in states (..., 8), (..., 4)."""
        return state[..., [0, 1, 4, 5]]

    def reached(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return which balls (B,) of states (B, 8) are in the goal."""
        ball = state[:, 4:6]
        return (ball[:, 0] >= self.goal_line_m) & (ball[:, 1].abs() <= self.goal_half_width_m)

    def missed(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return which balls (B,) of states (B, 8) left the field beside the goal."""
        x, y = state[:, 4:6].unbind(-1)
        out = (x >= self.goal_line_m) | (x < self.back_line_m) | (y.abs() > self.side_line_m)
        return out & ~self.reached(state, goal)

    def reward(self, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
        """Return the reward (B,) of a step between states (B, 8), a failure where `failed` (B,)."""
        gained = self._potential(after, goal) - self._potential(before, goal)
        return gained + self.success_reward * self.reached(after, goal) + self.failure_reward * failed

    def _potential(self, state: Tensor, goal: Tensor) -> Tensor:
        robot, _, ball, _ = state[:, :8].split(2, dim=-1)
        ball_left: Tensor = (goal - ball).norm(dim=-1)
        robot_left: Tensor = (self._behind(ball, goal) - robot).norm(dim=-1)
        return -ball_left - 0.5 * robot_left
