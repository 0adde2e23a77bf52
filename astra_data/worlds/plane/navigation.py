"""Objectives, simulated targets and abstract simulators in a maze: the point mass, which follows commands perfectly.

Navigation: reach a goal. The paper prints no reward, so it is ours.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.worlds.geometry import turned
from astra_data.worlds.objective import Objective
from astra_data.worlds.plane.mazes import FreeSpace, GoalDistance, Maze, free_space
from astra_data.worlds.protocols import Step, TaskSimulator
from astra_data.worlds.simulators import FreeStates
from astra_data.worlds.variation import Variation, VariedSimulator, noisy_command


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
            got = f"3 spread_m + path_clearance_m = {farthest:g} m around its center: take a smaller spread_m"
            raise BadInputError(f"expected goals within their cell of {self.maze.scale:g} m, got {got}")

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
            most = f"{self.maze.clearance_field.max():.3g} m, the largest clearance in the maze"
            raise BadInputError(f"start_clearance_m: expected less than {most}, got {self.start_clearance_m:g}")
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

    def goal_distance(self, position: Tensor, goal: Tensor) -> Tensor:
        """Return the length in m (..., B) of the shortest free path from `position` (..., B, 2) to `goal` (B, 2)."""
        sizes = {"spacing_m": self.spread_m, "radius_m": self.path_clearance_m}
        return GoalDistance.of_maze(self.maze, **sizes, device=str(goal.device))(position, goal)

    def reward(self, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
        """Return the reward (B,) of a step between states that begin with the position, (B, 2 or more)."""
        bonus = self.success_reward * self.reached(after, goal) + self.failure_reward * failed
        distance = self.goal_distance(torch.stack([before[:, :2], after[:, :2]]), goal)
        return self.meter_reward * (distance[0] - distance[1]) + bonus


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
        reward = self.objective.reward(before, after, self.goal, self.failed)
        return Step(self._observe(), reward, terminated=success | self.failed, success=success)

    def _observe(self) -> Tensor:
        return torch.cat([self.state, self.goal], dim=-1)


_CELLS_APART = 1e-6  # how far a radius may be from a whole number of cells, by rounding


class PlanarStates(FreeStates):
    """B planar states (B, X) that begin with x, y, vx, vy of a disc among the walls of a maze, in m and m/s."""

    state_size: int

    def __init__(
        self,
        maze: Maze,
        num_envs: int,
        *,
        timestep_s: float,
        radius_m: float = 0.1,
        speed_m_s: float = 1.0,
        device: str = "cpu",
    ) -> None:
        """Put B of them at rest at the origin, `radius_m` from walls, `speed_m_s` fast along each axis."""
        if abs(radius_m / maze.fine_m - round(radius_m / maze.fine_m)) > _CELLS_APART:
            expected = f"expected a multiple of the maze's fine_m, {maze.fine_m} m, got {radius_m}"
            raise BadInputError(f"radius_m: {expected}: take another radius, or a finer maze")
        if (way_m := timestep_s * speed_m_s) > maze.scale / 2:
            expected = f"expected steps of {maze.scale / 2:g} m, half a cell of the maze, or shorter"
            raise BadInputError(f"speed_m_s: {expected}, got {way_m:g} m: longer ones pass through walls")
        self.parameters = {"timestep_s": timestep_s, "radius_m": radius_m, "speed_m_s": speed_m_s}
        self.free = free_space(maze, radius_m=radius_m, device=device)
        self._maze = maze
        self._settles_in: FreeSpace | None = None  # other than its own
        super().__init__(torch.zeros(num_envs, self.state_size, device=device))
        self.period_s: Tensor | float = timestep_s
        self._gain: Tensor | None = None
        self._heading_bias_rad = torch.zeros(())

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use the parameters of a `PlanarVariation` by name, (B, 1) each, from the next step on."""
        self.period_s = self.parameters["timestep_s"] * parameters["timestep_scale"]
        self._gain = parameters["friction"] * (1.0 + parameters["action_scale"])
        self._heading_bias_rad = torch.deg2rad(parameters["heading_bias_deg"][:, 0])

    def commanded_velocity(self, command: Tensor) -> Tensor:
        """Return the velocity (B, 2) in m/s that `command` (B, 2) asks for, clipped to ±1 per axis first."""
        clipped = command.clamp(-1.0, 1.0)
        if self._gain is not None:
            clipped = self._gain * turned(clipped, self._heading_bias_rad)
        return clipped * self.parameters["speed_m_s"]

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, X)."""
        super().reset_to(state, rows)
        if rows is not None:
            self.blocked = self.blocked.index_fill(0, rows, False)

    def keep_clear(self, distance_m: float) -> None:
        """Let corrections end no closer to walls than `distance_m`, to the nearest fine cell; steps come closer."""
        widest = max(distance_m, self.parameters["radius_m"])
        self._settles_in = free_space(self._maze, radius_m=widest, device=str(self.state.device))

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Slide discs from `before` toward `landed` (B, X); who is kept clear of a wall stands there."""
        position, stopped = (self._settles_in or self.free).slide(before[:, :2], landed[:, :2])
        self.blocked = self.blocked | stopped
        velocity = landed[:, 2:4]
        if self._settles_in:
            moved = (position - before[:, :2]) / self.period_s
            velocity = torch.where(position == landed[:, :2], velocity, moved)
        self.reset_to(torch.cat([position, velocity, landed[:, 4:]], dim=-1))
        return self.state


class VariedPlanar(VariedSimulator):
    """B point masses, each with a `PlanarVariation`; states that were set or corrected are observed without noise."""

    def __init__(self, simulator: TaskSimulator, variation: Variation) -> None:
        super().__init__(simulator, variation)
        self._observed = simulator.state

    @property
    def state(self) -> Tensor:
        """The observed states, (B, X) float32."""
        return self._observed

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the true states in `rows` (n,), by default all, to `state` (n, X)."""
        self.simulator.reset_to(state, rows)
        self._observed = self.simulator.state if rows is None else self._observed.index_copy(0, rows, state)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` as far toward `landed`, both (B, X), as there is room; return where (B, X)."""
        self._observed = self.simulator.settle(before, landed)
        return self._observed

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, A), which begin with a velocity; return the observed states (B, X)."""
        parameters = self.by_name()
        velocity, rest = action.tensor_split([2], dim=-1)
        command = torch.cat([noisy_command(velocity, parameters["action_noise"]), rest], dim=-1)
        self.simulator.vary(parameters)
        true = self.simulator.step(command)
        noises = ("position_noise_m", "velocity_noise_m_s", "ball_position_noise_m", "ball_velocity_noise_m_s")
        half_widths = [parameters[name].expand(-1, 2) for name in noises if name in parameters]
        self._observed = true + (torch.rand_like(true) * 2.0 - 1.0) * torch.cat(half_widths, dim=-1)
        return self._observed


class PointMass(PlanarStates):
    """B point masses [x, y, vx, vy] in a maze, in m and m/s; a command is the velocity of the next step."""

    state_size = 4

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 2), clipped to ±1 per axis; return the new state (B, 4)."""
        position = self.state[:, :2]
        moved, self.blocked = self.free.slide(position, position + self.commanded_velocity(action) * self.period_s)
        self.state = torch.cat([moved, (moved - position) / self.period_s], dim=-1)
        return self.state
