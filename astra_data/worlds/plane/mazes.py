"""Mazes of square cells (row, column) from the top left; fine grids are indexed [y, x] from the lower left."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, scipy, torch


@dataclass(frozen=True)
class Maze:
    """A maze of square cells."""

    rows: tuple[str, ...]  # "1" is wall, "0" is free
    scale: float  # side of a cell in m
    start: tuple[int, int]  # (row, column) of the usual start cell
    goal: tuple[int, int]
    fine_m: float = 0.1  # cell size of the fine grid for clearances and distances; divides the scale

    def __post_init__(self) -> None:
        faults = []
        if not self.rows or not self.rows[0] or len({len(row) for row in self.rows}) != 1:
            faults.append("rows: expected strings of one length")
        elif set("".join(self.rows)) - {"0", "1"}:
            faults.append("rows: expected 1 for a wall and 0 for free space")
        else:
            faults += [
                f"{name}: expected (row, column) of a free cell, got {cell}"
                for name, cell in (("start", self.start), ("goal", self.goal))
                if cell not in self.cells(walls=False)
            ]
        per_cell = self.scale / self.fine_m if self.fine_m > 0 else 0.0
        if self.scale <= 0 or round(per_cell) < 2 or abs(per_cell - round(per_cell)) > 1e-6:
            faults.append(f"fine_m: expected a half of the scale, {self.scale} m, or a smaller part, got {self.fine_m}")
        if faults:
            raise BadInputError(f"maze: {'; '.join(faults)}")

    @cached_property
    def walls(self) -> Bools:
        """The grid of walls, (rows, columns)."""
        return np.array([[cell == "1" for cell in row] for row in self.rows])

    @property
    def half_extent(self) -> Floats:
        """Half of the maze's width and height in m, (2,)."""
        height, width = self.walls.shape
        return np.array([width, height]) * self.scale / 2

    def cell_center(self, row: int, column: int) -> tuple[float, float]:
        """Return the center (x, y) of a cell in m."""
        half_width, half_height = self.half_extent
        return (column + 0.5) * self.scale - half_width, half_height - (row + 0.5) * self.scale

    def cells(self, *, walls: bool) -> list[tuple[int, int]]:
        """Return the (row, column) of every cell that is wall, or of every free one, row by row."""
        return [(int(row), int(column)) for row, column in np.argwhere(self.walls == walls)]

    @cached_property
    def fine_walls(self) -> Bools:
        """The walls on a grid of `fine_m`, indexed [y, x] from the lower left corner."""
        per_cell = round(self.scale / self.fine_m)
        return np.kron(self.walls[::-1], np.ones((per_cell, per_cell), dtype=bool)).astype(bool)

    @cached_property
    def clearance_field(self) -> Floats:
        """Distance in m from each fine cell to the center of the nearest wall cell, [y, x]; around it there is wall."""
        free = np.pad(~self.fine_walls, 1)
        return np.asarray(scipy.ndimage.distance_transform_edt(free))[1:-1, 1:-1] * self.fine_m

    def fine_index(self, points: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the fine grid indices (y, x) of `points` (..., 2), clipped to the grid."""
        cells = np.floor((points + self.half_extent) / self.fine_m).astype(np.intp)
        height, width = self.fine_walls.shape
        return cells[..., 1].clip(0, height - 1), cells[..., 0].clip(0, width - 1)

    def clearance(self, points: Floats) -> Floats:
        """Return the distance in m from `points` (..., 2) to the nearest wall, up to `fine_m` too large."""
        return np.asarray(self.clearance_field[self.fine_index(points)])

    def distance_field(self, goal: Floats, *, radius: float = 0.0, margin: float = 0.0) -> Floats:
        """Return the length in m of the shortest free path from each fine cell to `goal` (2,), [y, x].

        Cells within `margin` m of walls cost more; those within `radius` m, or closed off, take that of a free one.
        """
        free = self.clearance_field > radius
        goal_cell = self.fine_index(goal)
        if not free[goal_cell]:
            at = f"({goal[0]:.2f}, {goal[1]:.2f})"
            raise BadInputError(f"expected a goal farther than {radius:g} m from walls, got {at}")
        numbers = np.full(free.shape, -1, dtype=np.int32)  # as the search takes them, in every version
        numbers[free] = np.arange(free.sum())
        cost = np.ones(free.shape)
        if margin > 0:
            cost += 20.0 * np.clip(1.0 - self.clearance_field / margin, 0.0, 1.0)
        (height, width), (sources, targets, weights) = free.shape, ([], [], [])
        # Knight moves beside the eight neighbors keep the error of grid distances below 3 %.
        for dy, dx in [(0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1)]:
            here = np.s_[: height - dy, max(0, -dx) : width - max(0, dx)]
            there = np.s_[dy:, max(0, dx) : width + min(0, dx)]
            both = free[here] & free[there]
            sources.append(numbers[here][both])
            targets.append(numbers[there][both])
            weights.append((0.5 * (cost[here] + cost[there])[both]) * np.hypot(dy, dx))
        count = int(free.sum())
        entries = (np.concatenate(weights), (np.concatenate(sources), np.concatenate(targets)))
        graph = scipy.sparse.coo_array(entries, shape=(count, count)).tocsr()
        source = int(numbers[goal_cell])
        lengths = np.asarray(scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=source)) * self.fine_m
        field = np.full(free.shape, np.inf)
        field[free] = lengths
        away, nearest = scipy.ndimage.distance_transform_edt(np.isinf(field), return_indices=True)
        return np.asarray(field[tuple(nearest)] + away * self.fine_m)


# gymnasium-robotics' U_MAZE at its own scale.
U_MAZE = Maze(("11111", "10001", "11101", "10001", "11111"), scale=4.0, start=(1, 1), goal=(3, 1))
# Two U's in a row, four right-angle turns, 40 m along the center line: ours, the paper prints no layout.
LONG_MAZE = Maze(("11111", "10001", "11101", "10001", "10111", "10001", "11111"), scale=4.0, start=(1, 1), goal=(5, 3))
# An S with corridors of 1 m on half a field of RoboCup's Standard Platform League. Ours too.
_S_ROWS = ("111111", "100001", "111101", "100001", "101111", "100001", "111111")
S_MAZE = Maze(_S_ROWS, scale=1.0, start=(1, 1), goal=(5, 4), fine_m=0.05)
# A room of 5 m by 5 m for playing with a ball.
FIELD = Maze(("1" * 12, *("1" + "0" * 10 + "1",) * 10, "1" * 12), scale=0.5, start=(5, 2), goal=(5, 9), fine_m=0.05)

_EDGE_M = 1e-4  # distance from the face of a blocked cell at which a sliding point is stopped


class FreeSpace:
    """The cells of a maze in which the center of a disc may be, to the nearest cell of the grid: not `blocked` ones."""

    def __init__(self, maze: Maze, *, radius_m: float, device: str = "cpu") -> None:
        reach = round(radius_m / maze.fine_m)
        square = np.ones((2 * reach + 1, 2 * reach + 1), dtype=bool)
        blocked = scipy.ndimage.binary_dilation(maze.fine_walls, square, border_value=1)
        self.blocked, self.cell_m = torch.from_numpy(blocked).to(device), maze.fine_m
        self.half_extent = torch.tensor(maze.half_extent, dtype=torch.float32, device=device)
        # Distance of blocked cells from the nearest free one, in cells; 0 in free ones.
        self._depth = torch.from_numpy(scipy.ndimage.distance_transform_edt(blocked)).float().to(device)
        self._limits = torch.tensor(blocked.shape[::-1], device=device) - 1

    def slide(self, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        """Move points from `start` to `end` (B, 2), each axis up to blocked cells; return where, and who stopped."""
        here, there = self.cells(torch.stack([start, end]))
        (from_x, from_y), (to_x, to_y) = here.unbind(-1), there.unbind(-1)
        onward = there > here
        face = (here + onward) * self.cell_m - self.half_extent
        face_x, face_y = torch.where(onward, face - _EDGE_M, face + _EDGE_M).unbind(-1)
        end_x, end_y = end.unbind(-1)
        depth, depth_x = self._depth[from_y, from_x], self._depth[from_y, to_x]
        stop_x = depth_x > depth
        x = torch.where(stop_x, face_x, end_x)
        column = torch.where(stop_x, from_x, to_x)
        stop_y = self._depth[to_y, column] > torch.where(stop_x, depth, depth_x)
        y = torch.where(stop_y, face_y, end_y)
        return torch.stack([x, y], dim=-1), stop_x | stop_y

    def cells(self, position: Tensor) -> Tensor:
        """Return the column and the row (..., 2) of the fine grid's cell of each `position` (..., 2)."""
        cells = ((position + self.half_extent) / self.cell_m).floor().long()
        return torch.minimum(cells.clamp_min(0), self._limits)


free_space = lru_cache(maxsize=16)(FreeSpace)  # for who builds simulators often


@dataclass(frozen=True)
class GoalDistance:
    """Length of the shortest free path to a goal near the maze's goal cell: a field for each point of a lattice."""

    fields: Tensor  # (goals, height, width) in m
    lattice: Tensor  # the goal of each field, (goals, 2) in m
    half_extent: Tensor  # of the maze, (2,) in m
    cell_m: float  # side of a field's cell

    @classmethod
    @lru_cache(maxsize=16)  # they take seconds, and are too large to move to an accelerator in every step
    def of_maze(cls, maze: Maze, *, spacing_m: float, radius_m: float = 0.0, device: str = "cpu") -> "GoalDistance":
        """Compute a disc's fields for 7 x 7 goals, `spacing_m` apart, around the goal cell's middle."""
        if device != "cpu":
            here = cls.of_maze(maze, spacing_m=spacing_m, radius_m=radius_m)
            return cls(here.fields.to(device), here.lattice.to(device), here.half_extent.to(device), here.cell_m)
        steps = np.arange(-3, 4) * spacing_m
        center = np.array(maze.cell_center(*maze.goal))
        lattice = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2) + center
        fields = np.stack([maze.distance_field(goal, radius=radius_m) for goal in lattice])
        half_extent = torch.tensor(maze.half_extent, dtype=torch.float32)
        return cls(torch.from_numpy(fields).float(), torch.from_numpy(lattice).float(), half_extent, maze.fine_m)

    def __call__(self, position: Tensor, goal: Tensor) -> Tensor:
        """Return the distance in m (..., B), bilinear, from `position` (..., B, 2) to `goal` (B, 2)."""
        # Axis by axis, since a sum over a last dimension of two is slow.
        away_x, away_y = goal[:, :1] - self.lattice[:, 0], goal[:, 1:] - self.lattice[:, 1]
        field = (away_x.square() + away_y.square()).argmin(dim=1)
        _, height, width = self.fields.shape
        x, y = ((position + self.half_extent) / self.cell_m - 0.5).unbind(-1)  # values are those at cell centers
        x, y = x.clamp(0, width - 1.001), y.clamp(0, height - 1.001)
        column, row = x.floor(), y.floor()
        fx, fy = x - column, y - row
        at, values = (field * height + row.long()) * width + column.long(), self.fields.flatten()
        lower = values[at] * (1 - fx) + values[at + 1] * fx
        upper = values[at + width] * (1 - fx) + values[at + width + 1] * fx
        return lower * (1 - fy) + upper * fy
