"""The abstract simulator of navigation: a planar point mass that follows velocity commands perfectly."""

import torch
from torch import Tensor

from astra_data.worlds.plane.states import PlanarStates


class PointMass(PlanarStates):
    """B point masses [x, y, vx, vy] in a maze, in m and m/s.

    A command is the velocity of the next step, in units of the top speed along each axis; walls stop each
    axis by itself. The velocity in the state is the displacement in the last step over its duration. Left
    out: the legs and all their dynamics.
    """

    state_size = 4
    action_size = 2

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 2), clipped to ±1 per axis; return the new state (B, 4)."""
        position = self.state[:, :2]
        moved, self.blocked = self.free.slide(
            position, position + self.commanded_velocity(action) * self.period_s
        )
        self.state = torch.cat([moved, (moved - position) / self.period_s], dim=-1)
        return self.state
