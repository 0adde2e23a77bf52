"""Objectives and simulated targets in a maze; navigation: reach a goal. The paper prints no reward, so it is ours."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.worlds.objective import Objective
from astra_data.worlds.plane.mazes import GoalDistance, Maze
from astra_data.worlds.protocols import Step


@dataclass(frozen=True)
class PlanarObjective(Objective):
    """An objective in `maze`; states begin with x and y of the robot in m, actions with its velocity."""

    action_size = 2
    goal_size = 2

    maze: Maze

    @abstractmethod
    def draw_anywhere(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw states (count, X), at rest, anywhere in the free space; where there is a ball, near it."""

    def limit_command(self, action: Tensor, limit: float) -> Tensor:
        """Shorten the velocities that actions (..., A) begin with, ±1 per axis, to at most `limit`."""
        command, rest = super().limit_command(action, limit).tensor_split([2], dim=-1)
        speed = command.norm(dim=-1, keepdim=True)
        shorten: Tensor = (limit / speed.clamp_min(1e-6)).clamp_max(1.0)
        return torch.cat([command * shorten, rest], dim=-1)

    def places(self, state: Tensor) -> Tensor:
        """Return x and y in m of the bodies in states (..., X); by default of the robot alone, (..., 2)."""
        return state[..., :2]


@dataclass(frozen=True)
class Navigation(PlanarObjective):
    """Reach the goal of `maze` within `horizon` steps, paid for progress along the shortest free path."""

    meter_reward: float = 1.0  # for a meter of progress
    path_clearance_m: float = 0.0  # from walls, of the shortest free path
    position_waves: int = 0  # of which policies see sine and cosine; each is half as long as the one before
    success_radius_m: float = 0.45
    spread_m: float = 0.2  # standard deviation of start and goal around their cells' centers, per axis
    start_clearance_m: float = 0.8  # from walls, of starts that are drawn anywhere
    start_offsets_m: tuple[tuple[float, float], ...] = ((0.0, 0.0),)  # from the center of the start cell

    def __post_init__(self) -> None:
        farthest = 3 * self.spread_m + self.path_clearance_m
        if farthest >= self.maze.scale / 2:
            raise BadInputError(
                f"expected goals within their cell of {self.maze.scale:g} m, got 3 spread_m + "
                f"path_clearance_m = {farthest:g} m around its center: take a smaller spread_m"
            )

    @cached_property
    def goal_distance(self) -> GoalDistance:
        """Path lengths to goals near the maze's goal cell."""
        return GoalDistance.of_maze(self.maze, spacing_m=self.spread_m, radius_m=self.path_clearance_m)

    @cached_property
    def _goal_distances(self) -> "dict[torch.device, GoalDistance]":
        return {}

    def draw_starts(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw states [x, y, vx, vy] (count, 4) at rest around the usual starts."""
        position = self._around(self.maze.start, rng, count)
        offsets = np.array(self.start_offsets_m)
        return _at_rest(position + offsets[rng.integers(len(offsets), size=count)])

    def draw_goals(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw goals (count, 2) in m around the maze's goal cell."""
        return self._around(self.maze.goal, rng, count)

    def draw_anywhere(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw states [x, y, vx, vy] (count, 4) at rest, uniformly from the free space away from walls."""
        rows, columns = np.nonzero(self.maze.clearance_field > self.start_clearance_m)
        if not len(rows):
            raise BadInputError(
                f"start_clearance_m: expected less than {self.maze.clearance_field.max():.3g} m, the largest "
                f"clearance in the maze, got {self.start_clearance_m:g}"
            )
        chosen = rng.integers(len(rows), size=count)
        cell = self.maze.half_extent * 2 / self.maze.fine_walls.shape[::-1]
        within = rng.random((count, 2))
        corner = np.stack([columns[chosen], rows[chosen]], axis=-1)
        return _at_rest((corner + within) * cell - self.maze.half_extent)

    def _around(self, cell: tuple[int, int], rng: np.random.Generator, count: int) -> Floats:
        noise = rng.normal(0.0, self.spread_m, (count, 2)).clip(-3 * self.spread_m, 3 * self.spread_m)
        return np.asarray(np.array(self.maze.cell_center(*cell)) + noise)

    def observe(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return position, velocity, goal and the vector to it, (..., 8), and the position's waves."""
        half = torch.tensor(self.maze.half_extent, dtype=state.dtype, device=state.device)
        position, velocity = state[..., :2], state[..., 2:]
        waves = [torch.pi * 2**octave * position / half for octave in range(self.position_waves)]
        seen = [position / half, velocity, goal / half, (goal - position) / half]
        return torch.cat([*seen, *map(torch.sin, waves), *map(torch.cos, waves)], dim=-1)

    def reached(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return which states (B, 2 or more), beginning with x and y, are at the `goal` (B, 2), (B,) bool."""
        return (state[:, :2] - goal).square().sum(-1).le(self.success_radius_m**2)

    def progress(self, before: Tensor, after: Tensor, goal: Tensor) -> Tensor:
        """Return the progress in m (B,) toward `goal` (B, 2) from `before` to `after`, (B, 2 or more)."""
        fields = self._goal_distances
        if goal.device not in fields:  # they are too large to move to an accelerator in every step
            fields[goal.device] = self.goal_distance.to(goal.device)
        distance = fields[goal.device](torch.stack([before[:, :2], after[:, :2]]), goal)
        return distance[0] - distance[1]

    def reward(self, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
        """Return the reward (B,) of a step between states that begin with the position, (B, 2 or more)."""
        bonus = self.success_reward * self.reached(after, goal) + self.failure_reward * failed
        return self.meter_reward * self.progress(before, after, goal) + bonus


def _at_rest(position: Floats) -> Floats:
    return np.concatenate([position, np.zeros_like(position)], axis=1)


class PlanarTarget(ABC):
    """B robots in a maze; an observation (B, O) is the state, then the goal."""

    def __init__(self, objective: PlanarObjective, num_envs: int, *, start_anywhere: bool = False) -> None:
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
        draw = self.objective.draw_anywhere if self.start_anywhere else self.objective.draw_starts
        return draw(self._rng, len(rows))

    def _aim(self, rows: NDArray[np.intp]) -> None:
        self.goal[rows] = torch.from_numpy(self.objective.draw_goals(self._rng, len(rows))).float()

    def _judged(self, before: Tensor, after: Tensor, fallen: Bools) -> Step:
        """Return the outcome of a step between states with true positions; who reaches the goal has not failed."""
        success = self.objective.reached(after, self.goal)
        walls = self.wall_contact & self.objective.ends_at_walls
        self.failed = (torch.from_numpy(fallen) | self.objective.missed(after, self.goal) | walls) & ~success
        return Step(
            observation=self._observe(),
            reward=self.objective.reward(before, after, self.goal, self.failed),
            terminated=success | self.failed,
            success=success,
        )

    def _observe(self) -> Tensor:
        return torch.cat([self.state, self.goal], dim=-1)
