"""Free space of a maze: an occupancy grid that stops moving points, and distances to a goal. Batched torch.

Grids have square cells of the maze's `fine_m` and are indexed [y, x] from the maze's lower left corner.
"""

from copy import copy
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
import torch
from torch import Tensor

from astra_data.worlds.plane.mazes import Maze

_EDGE_M = 1e-4
"""Distance from the face of a blocked cell at which a sliding point is stopped."""


class FreeSpace:
    """The cells in which the center of a disc may be.

    Attributes:
        blocked: (height, width) bool, True where the disc would overlap a wall.
        half_extent: half of the maze's width and height in m, (2,).
        cell_m: side of a cell.
    """

    def __init__(self, blocked: Tensor, half_extent: Tensor, cell_m: float) -> None:
        self.blocked = blocked
        self.half_extent = half_extent
        self.cell_m = cell_m
        depth = torch.from_numpy(scipy.ndimage.distance_transform_edt(blocked.cpu().numpy()))
        # Distance of blocked cells from the nearest free one, in cells; 0 in free ones.
        self._depth = depth.float().to(blocked.device)
        self._limits = torch.tensor(blocked.shape[::-1], device=blocked.device) - 1

    @classmethod
    def of_maze(cls, maze: Maze, *, radius_m: float, device: str = "cpu") -> "FreeSpace":
        """Return the free space of a disc of `radius_m`, to the nearest cell of the grid."""
        return copy(_free_space(maze, round(radius_m / maze.fine_m), device))

    def cells(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Return the row and the column (...) of the fine grid's cell of each `position` (..., 2)."""
        column, row = self._cells(position).unbind(-1)
        return row, column

    def slide(self, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        """Move points from `start` to `end`, both (B, 2) in m, stopping each axis at blocked cells.

        Only the cells where a move begins and ends are looked at; one that is stopped ends where its own
        cell does. A point that starts in a blocked cell may move in it and out of it, but not deeper into it.

        Returns:
            the points' new positions (B, 2), and which points were stopped (B,).
        """
        here, there = self._cells(torch.stack([start, end]))
        (from_x, from_y), (to_x, to_y) = here.unbind(-1), there.unbind(-1)
        face_x, face_y = self._faces(here, there).unbind(-1)
        end_x, end_y = end.unbind(-1)
        depth, depth_x = self._depth[from_y, from_x], self._depth[from_y, to_x]
        stop_x = depth_x > depth
        x = torch.where(stop_x, face_x, end_x)
        column = torch.where(stop_x, from_x, to_x)
        stop_y = self._depth[to_y, column] > torch.where(stop_x, depth, depth_x)
        y = torch.where(stop_y, face_y, end_y)
        return torch.stack([x, y], dim=-1), stop_x | stop_y

    def _cells(self, position: Tensor) -> Tensor:
        cells = ((position + self.half_extent) / self.cell_m).floor().long()
        return torch.minimum(cells.clamp_min(0), self._limits)

    def _faces(self, here: Tensor, there: Tensor) -> Tensor:
        """Return where points that move between the cells (B, 2) are stopped on each axis, (B, 2) in m."""
        onward = there > here
        face = (here + onward) * self.cell_m - self.half_extent
        return torch.where(onward, face - _EDGE_M, face + _EDGE_M)


@lru_cache(maxsize=16)
def _free_space(maze: Maze, reach: int, device: str) -> FreeSpace:
    """Return the free space of a disc that reaches as many cells; kept, for who builds simulators often."""
    square = np.ones((2 * reach + 1, 2 * reach + 1), dtype=bool)
    blocked = scipy.ndimage.binary_dilation(maze.fine_walls, square, border_value=1)
    half_extent = torch.tensor(maze.half_extent, dtype=torch.float32, device=device)
    return FreeSpace(torch.from_numpy(blocked).to(device), half_extent, maze.fine_m)


@dataclass(frozen=True)
class GoalDistance:
    """Length of the shortest free path to a goal near the maze's goal cell.

    There is one distance field per point of a lattice around the cell's middle; a goal uses the nearest.

    Attributes:
        fields: (goals, height, width) in m.
        lattice: the goal of each field, (goals, 2) in m.
        half_extent: (2,) in m.
        cell_m: side of a field's cell.
    """

    fields: Tensor
    lattice: Tensor
    half_extent: Tensor
    cell_m: float

    @classmethod
    def of_maze(cls, maze: Maze, *, spacing_m: float, radius_m: float = 0.0) -> "GoalDistance":
        """Compute a disc's fields for 7 x 7 goals, `spacing_m` apart, around the goal cell's middle."""
        steps = np.arange(-3, 4) * spacing_m
        center = np.array(maze.cell_center(*maze.goal))
        lattice = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2) + center
        fields = np.stack([maze.distance_field(goal, radius=radius_m) for goal in lattice])
        return cls(
            torch.from_numpy(fields).float(),
            torch.from_numpy(lattice).float(),
            torch.tensor(maze.half_extent, dtype=torch.float32),
            maze.fine_m,
        )

    def to(self, device: str | torch.device) -> "GoalDistance":
        """Return the same fields on `device`."""
        fields, lattice, half_extent = (
            values.to(device) for values in (self.fields, self.lattice, self.half_extent)
        )
        return GoalDistance(fields, lattice, half_extent, self.cell_m)

    def __call__(self, position: Tensor, goal: Tensor) -> Tensor:
        """Return the distance in m (..., B) from `position` (..., B, 2) to `goal` (B, 2).

        It is bilinear in the position.
        """
        # Axis by axis, since a sum over a last dimension of two is slow.
        away_x, away_y = goal[:, :1] - self.lattice[:, 0], goal[:, 1:] - self.lattice[:, 1]
        field = (away_x.square() + away_y.square()).argmin(dim=1)
        _, height, width = self.fields.shape
        # Values are those at cell centers.
        x, y = ((position + self.half_extent) / self.cell_m - 0.5).unbind(-1)
        x, y = x.clamp(0, width - 1.001), y.clamp(0, height - 1.001)
        column, row = x.floor(), y.floor()
        fx, fy = x - column, y - row
        at, values = (field * height + row.long()) * width + column.long(), self.fields.flatten()
        lower = values[at] * (1 - fx) + values[at + 1] * fx
        upper = values[at + width] * (1 - fx) + values[at + width + 1] * fx
        return lower * (1 - fy) + upper * fy
