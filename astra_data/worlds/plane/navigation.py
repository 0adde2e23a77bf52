"""The navigation objective: reach a goal in a maze.

The paper prints no reward. Ours: progress along the shortest free path to the goal, +10 for reaching it, and
a negative reward for a failure.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.worlds.objective import PlanarObjective
from astra_data.worlds.plane.free_space import GoalDistance


@dataclass(frozen=True)
class Navigation(PlanarObjective):
    """Reach the goal of `maze` within `horizon` steps.

    Attributes:
        meter_reward: for a meter of progress.
        path_clearance_m: clearance from walls of the shortest free path.
        success_radius_m: distance from the goal within which the episode ends in success.
        position_waves: number of waves of which policies see sine and cosine of the position along each
            axis; the first is as long as the maze is wide, each other half as long as the one before.
        spread_m: standard deviation of start and goal around their cells' centers, per axis.
        start_clearance_m: clearance from walls of starts that are drawn anywhere.
        start_offsets_m: offsets of the usual starts from the center of the start cell, drawn uniformly.
    """

    meter_reward: float = 1.0
    path_clearance_m: float = 0.0
    position_waves: int = 0
    success_radius_m: float = 0.45
    spread_m: float = 0.2
    start_clearance_m: float = 0.8
    start_offsets_m: tuple[tuple[float, float], ...] = ((0.0, 0.0),)

    def __post_init__(self) -> None:
        """Check that starts and goals are in free space.

        Raises:
            BadInputError: they are spread into the walls around their cells.
        """
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
    def _goal_distances(self) -> dict[torch.device, GoalDistance]:
        return {}

    def _goal_distance_on(self, device: torch.device) -> GoalDistance:
        # Cached: the fields are too large to move to an accelerator in every step.
        if device not in self._goal_distances:
            self._goal_distances[device] = self.goal_distance.to(device)
        return self._goal_distances[device]

    def draw_starts(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw states [x, y, vx, vy] (count, 4) at rest around the usual starts."""
        position = self._around(self.maze.start, rng, count)
        offsets = np.array(self.start_offsets_m)
        return _at_rest(position + offsets[rng.integers(len(offsets), size=count)])

    def draw_goals(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw goals (count, 2) in m around the maze's goal cell."""
        return self._around(self.maze.goal, rng, count)

    def draw_anywhere(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw states [x, y, vx, vy] (count, 4) at rest, uniformly from the free space away from walls.

        Raises:
            BadInputError: no place is as far from walls as `start_clearance_m` says.
        """
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

    def _around(self, cell: tuple[int, int], rng: np.random.Generator, count: int) -> NDArray[np.float64]:
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
        distance = self._goal_distance_on(goal.device)(torch.stack([before[:, :2], after[:, :2]]), goal)
        return distance[0] - distance[1]

    def reward(self, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
        """Return the reward (B,) of a step between states that begin with the position, (B, 2 or more)."""
        bonus = self.success_reward * self.reached(after, goal) + self.failure_reward * failed
        return self.meter_reward * self.progress(before, after, goal) + bonus


def _at_rest(position: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([position, np.zeros_like(position)], axis=1)
