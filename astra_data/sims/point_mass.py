"""The abstract simulator of navigation: a planar point mass that follows velocity commands perfectly."""

import torch
from torch import Tensor

from astra_data.free_space import FreeSpace
from astra_data.mazes import Maze


class PointMass:
    """B point masses [x, y, vx, vy] in a maze, in m and m/s.

    A command is the velocity of the next step, in units of the top speed along each axis; walls stop it,
    each axis by itself. The velocity in the state is the motion that really happened. Left out: everything
    that has legs.

    Attributes:
        state: (B, 4) float32.
        free: where the point's centre may be.
        blocked: (B,) bool, the last step was stopped by a wall.
    """

    state_size = 4
    action_size = 2

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
        self.free = FreeSpace.of_maze(maze, radius_m=radius_m, device=device)
        self.num_envs = num_envs
        self.timestep_s = timestep_s
        self.radius_m = radius_m
        self.speed_m_s = speed_m_s
        self.state = torch.zeros(num_envs, self.state_size, device=device)
        self.blocked = torch.zeros(num_envs, dtype=torch.bool, device=device)

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {"timestep_s": self.timestep_s, "radius_m": self.radius_m, "speed_m_s": self.speed_m_s}

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, 4)."""
        if rows is None:
            self.state = state.clone()
        else:
            # New tensors, so that those handed out earlier stay as they were.
            self.state = self.state.index_copy(0, rows, state)
            self.blocked = self.blocked.index_fill(0, rows, False)

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 2), clipped to ±1 per axis; return the new state (B, 4)."""
        position = self.state[:, :2]
        way = action.clamp(-1.0, 1.0) * self.speed_m_s * self.timestep_s
        moved, self.blocked = self.free.slide(position, position + way)
        self.state = torch.cat([moved, (moved - position) / self.timestep_s], dim=-1)
        return self.state

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Slide from `before` towards `landed`, both (B, 4); velocities are those of `landed`."""
        position, self.blocked = self.free.slide(before[:, :2], landed[:, :2])
        self.state = torch.cat([position, landed[:, 2:]], dim=-1)
        return self.state
