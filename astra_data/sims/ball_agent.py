"""The abstract simulator of kicking: a planar point mass that knocks a rolling ball away."""

import torch
from torch import Tensor

from astra_data.ball import ROLLING_M_S2, knock, roll
from astra_data.free_space import FreeSpace
from astra_data.mazes import Maze


class BallAgent:
    """B point masses, each with a ball: [x, y, vx, vy, ball x, ball y, ball vx, ball vy], in m and m/s.

    A command is the velocity of the next step, in units of the top speed along each axis. Walls stop the
    mass, not the ball. A mass that walks into its ball knocks it away, at one speed, along the line between
    their centres. Left out: legs, feet and where they are, and which way the robot looks.

    Attributes:
        state: (B, 8) float32.
        free: where the mass may be. blocked: (B,) bool, a wall stopped the mass in the last step.
    """

    state_size = 8
    action_size = 2

    def __init__(
        self,
        maze: Maze,
        num_envs: int,
        *,
        timestep_s: float,
        radius_m: float,
        speed_m_s: float,
        reach_m: float,
        knock_m_s: float,
        device: str = "cpu",
    ) -> None:
        """Build B of them.

        Args:
            maze: walls around them.
            num_envs: B.
            timestep_s: control period.
            radius_m: of the mass, at walls.
            speed_m_s: top speed along each axis.
            reach_m: the mass touches the ball when their centres are closer.
            knock_m_s: speed of a ball that is knocked away.
            device: torch device.
        """
        self.free = FreeSpace.of_maze(maze, radius_m=radius_m, device=device)
        self.num_envs = num_envs
        self.parameters = {
            "timestep_s": timestep_s,
            "radius_m": radius_m,
            "speed_m_s": speed_m_s,
            "reach_m": reach_m,
            "knock_m_s": knock_m_s,
        }
        self.state = torch.zeros(num_envs, self.state_size, device=device)
        self.blocked = torch.zeros(num_envs, dtype=torch.bool, device=device)

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, 8)."""
        if rows is None:
            self.state = state.clone()
        else:
            self.state = self.state.index_copy(0, rows, state)
            self.blocked = self.blocked.index_fill(0, rows, False)

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 2), clipped to ±1 per axis; return the new state (B, 8)."""
        of = self.parameters
        position, _, ball, velocity = self.state.split(2, dim=-1)
        way = action.clamp(-1.0, 1.0) * of["speed_m_s"] * of["timestep_s"]
        moved, self.blocked = self.free.slide(position, position + way)
        ball, velocity = knock(
            position, moved, ball, velocity, reach_m=of["reach_m"], speed_m_s=of["knock_m_s"]
        )
        ball, velocity = roll(ball, velocity, of["timestep_s"], ROLLING_M_S2)
        self.state = torch.cat([moved, (moved - position) / of["timestep_s"], ball, velocity], dim=-1)
        return self.state

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Slide the masses from `before` towards `landed`, both (B, 8); all else is that of `landed`."""
        position, self.blocked = self.free.slide(before[:, :2], landed[:, :2])
        self.state = torch.cat([position, landed[:, 2:]], dim=-1)
        return self.state
