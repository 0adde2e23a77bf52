"""The abstract simulator of navigation: a planar point mass that follows velocity commands perfectly."""

import torch
from torch import Tensor

from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.plane.states import PlanarStates


class PointMass(PlanarStates):
    """B point masses [x, y, vx, vy] in a maze, in m and m/s.

    A command is the velocity of the next step, in units of the top speed along each axis; walls stop each
    axis by itself. The velocity in the state is the displacement in the last step over its duration. Left
    out: the legs and all their dynamics.

    Attributes:
        parameters: what a dataset paired with this simulator records about it.
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
        """Build B of them.

        Args:
            maze: the walls.
            num_envs: B.
            timestep_s: control period.
            radius_m: distance that the mass keeps from walls.
            speed_m_s: top speed along each axis.
            device: torch device.
        """
        super().__init__(
            maze,
            num_envs,
            self.state_size,
            timestep_s=timestep_s,
            radius_m=radius_m,
            speed_m_s=speed_m_s,
            device=device,
        )

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 2), clipped to ±1 per axis; return the new state (B, 4)."""
        position = self.state[:, :2]
        moved, self.blocked = self.free.slide(
            position, position + self.commanded_velocity(action) * self.period_s
        )
        self.state = torch.cat([moved, (moved - position) / self.period_s], dim=-1)
        return self.state
