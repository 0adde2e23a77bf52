"""The planar point mass with parameters that differ from row to row: for randomisation and identification."""

import torch
from torch import Tensor

from astra_data.free_space import FreeSpace
from astra_data.mazes import Maze
from astra_data.variation import Variation, varied_command


class VariedPointMass:
    """B point masses like those of `PointMass`, each with its own parameters (see `Variation`).

    A command gets noise, is clipped to ±1 per axis, scaled and turned; the mass follows it for one
    control period of its own length. What `state` shows is where it is plus the noise of the sensors; noise
    is drawn from torch's global generator. With the plain parameters it is the plain point mass.

    Attributes:
        parameters: (B, P), in the order of the variation's `names`.
        state: what is shown, (B, 4) float32. true_state: where the masses are, likewise.
        free: where the point's centre may be.
        blocked: (B,) bool, the last step was stopped by a wall.
    """

    state_size = 4
    action_size = 2

    def __init__(
        self,
        maze: Maze,
        num_envs: int,
        variation: Variation,
        *,
        timestep_s: float,
        radius_m: float = 0.1,
        speed_m_s: float = 1.0,
        device: str = "cpu",
    ) -> None:
        self.free = FreeSpace.of_maze(maze, radius_m=radius_m, device=device)
        self.variation = variation
        self.num_envs = num_envs
        self.timestep_s = timestep_s
        self.speed_m_s = speed_m_s
        self.state = torch.zeros(num_envs, self.state_size, device=device)
        self.true_state = self.state
        self.blocked = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.parameters = variation.draw(num_envs, device)

    def redraw(self, rows: Tensor) -> None:
        """Draw new parameters for the rows `rows` (n,)."""
        drawn = self.variation.draw(len(rows), self.parameters.device)
        self.parameters = self.parameters.index_copy(0, rows, drawn)

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, 4)."""
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)
        self.true_state = state.clone() if rows is None else self.true_state.index_copy(0, rows, state)
        if rows is not None:
            self.blocked = self.blocked.index_fill(0, rows, False)

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 2); return what is shown of the new state (B, 4)."""
        of = self.variation.by_name(self.parameters)
        velocity = varied_command(of, action) * self.speed_m_s
        period = (self.timestep_s * of["timestep_scale"]).unsqueeze(-1)
        position = self.true_state[:, :2]
        moved, self.blocked = self.free.slide(position, position + velocity * period)
        self.true_state = torch.cat([moved, (moved - position) / period], dim=-1)
        widths = torch.stack([of["position_noise_m"], of["velocity_noise_m_s"]], dim=-1)
        shown = torch.rand_like(self.true_state) * 2.0 - 1.0
        self.state = self.true_state + shown * widths.repeat_interleave(2, dim=-1)
        return self.state

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Slide from `before` towards `landed`, both (B, 4); velocities are those of `landed`."""
        position, self.blocked = self.free.slide(before[:, :2], landed[:, :2])
        self.reset_to(torch.cat([position, landed[:, 2:]], dim=-1))
        return self.state
