"""The abstract simulator of navigation, a point mass that follows commands perfectly; its variations."""

from collections.abc import Mapping

from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.worlds.geometry import turned
from astra_data.worlds.plane.mazes import FreeSpace, Maze
from astra_data.worlds.protocols import TaskSimulator
from astra_data.worlds.simulators import FreeStates
from astra_data.worlds.variation import Variation, VariedSimulator, noisy_command

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
            raise BadInputError(
                f"radius_m: expected a multiple of the maze's fine_m, {maze.fine_m} m, got {radius_m}: "
                "take another radius, or a finer maze"
            )
        self.parameters = {"timestep_s": timestep_s, "radius_m": radius_m, "speed_m_s": speed_m_s}
        self.free = FreeSpace.of_maze(maze, radius_m=radius_m, device=device)
        self._maze = maze
        self._settles_in: FreeSpace | None = None  # other than its own
        self.num_envs = num_envs
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
        self._settles_in = FreeSpace.of_maze(self._maze, radius_m=widest, device=str(self.state.device))

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
    action_size = 2

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 2), clipped to ±1 per axis; return the new state (B, 4)."""
        position = self.state[:, :2]
        moved, self.blocked = self.free.slide(position, position + self.commanded_velocity(action) * self.period_s)
        self.state = torch.cat([moved, (moved - position) / self.period_s], dim=-1)
        return self.state
