"""A careful hand-written follower of the corridors: how well the task can be done (the ceiling)."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from astra_data.mazes import Maze
from astra_data.method import Method

FOLLOWER = Method(name="follower", title="Careful follower", learn=None)


@dataclass(frozen=True)
class CarefulFollower:
    """Steer down the distance to the goal, along paths away from the walls, a little below full speed.

    Attributes:
        maze: where. margin_m: distance from the walls that paths keep where they can.
        speed_m_s: of the faster axis.
    """

    maze: Maze
    margin_m: float = 1.6
    speed_m_s: float = 0.85

    def fields(self, goals: Tensor) -> Tensor:
        """Return the cost of going from each fine cell to each of `goals` (B, 2), (B, height, width)."""
        fields = [self.maze.distance_field(goal, self.margin_m) for goal in goals.numpy()]
        return torch.from_numpy(np.stack(fields)).float()

    def command(self, position: Tensor, goal: Tensor, fields: Tensor) -> Tensor:
        """Return velocity commands (B, 2), at `position` (B, 2) for `goal` (B, 2).

        Looks 0.8 m around in `fields` (B, height, width) for the cheapest direction out of 32; near the
        goal it heads straight there.
        """
        angles = torch.arange(32) * (2 * torch.pi / 32)
        directions = torch.stack([angles.cos(), angles.sin()], dim=-1)
        ahead = position[:, None] + 0.8 * directions
        half = torch.tensor(self.maze.half_extent, dtype=torch.float32)
        cells = ((ahead + half) / self.maze.fine_m).long()
        rows = cells[..., 1].clamp(0, fields.shape[1] - 1)
        columns = cells[..., 0].clamp(0, fields.shape[2] - 1)
        costs = fields[torch.arange(len(position))[:, None], rows, columns]
        best = directions[costs.argmin(dim=1)]
        straight = goal - position
        near = straight.norm(dim=-1, keepdim=True) < 1.0
        heading = torch.where(near, straight, best)
        return self.speed_m_s * heading / heading.abs().amax(dim=-1, keepdim=True).clamp_min(1e-6)
