from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.worlds.plane.mazes import U_MAZE, FreeSpace, GoalDistance, Maze

CORRIDOR = Maze(rows=("1111111", "1000001", "1111111"), scale=4.0, start=(1, 1), goal=(1, 5))


def shortest(maze: Maze, start: tuple[float, float], goal: tuple[float, float]) -> float:
    return float(maze.distance_field(np.array(goal))[maze.fine_index(np.array(start))])


def test_around_the_grid_there_is_wall() -> None:
    # As in `FreeSpace`, whose points do not leave the grid.
    field = Maze(rows=("000", "010"), scale=1.0, start=(0, 0), goal=(1, 2), fine_m=0.5).clearance_field
    assert field.tolist() == [[0.5, 0.5, 0.0, 0.0, 0.5, 0.5]] * 2 + [
        [0.5, 0.5 * 2**0.5, 0.5, 0.5, 0.5 * 2**0.5, 0.5],
        [0.5] * 6,
    ]
    bare = Maze(rows=("00", "00"), scale=1.0, start=(0, 0), goal=(1, 1), fine_m=0.25).clearance_field
    ring = np.minimum(np.arange(1, 9), np.arange(8, 0, -1)) / 4
    assert (bare == np.minimum(ring[:, None], ring)).all()


def test_distance_around_the_u() -> None:
    # The U's inner wall ends in the corners (2, 2) and (2, -2): two slanted legs and its end between them.
    length = 2 * np.hypot(6.0, 2.0) + 4.0
    assert shortest(U_MAZE, (-4.0, 4.0), (-4.0, -4.0)) == pytest.approx(length, rel=0.03)


def test_a_disc_goes_around_corners_at_its_radius() -> None:
    # A tight string: a tangent to the circle about each corner, an arc, and the wall's end between them.
    apart = np.hypot(6.0, 2.0)
    arc = np.arctan2(2.0, -6.0) - np.arccos(1.0 / apart)
    length = 2 * (np.sqrt(apart**2 - 1.0) + arc) + 4.0
    goal, start = np.array([-4.0, -4.0]), U_MAZE.fine_index(np.array([-4.0, 4.0]))
    assert U_MAZE.distance_field(goal, radius=1.0)[start] == pytest.approx(length, rel=0.03)
    # 0.5 m from a wall it is 0.5 m from where it may be: in the aisle's middle, 1 m on.
    field = U_MAZE.distance_field(goal, radius=1.0)
    assert field[U_MAZE.fine_index(np.array([0.0, -5.45]))] == pytest.approx(
        field[U_MAZE.fine_index(np.array([0.0, -4.95]))] + 0.5, abs=0.15
    )


def test_who_goes_downhill_keeps_the_margin_all_the_way() -> None:
    goal = np.array([-4.0, -4.0])
    field, clearance = U_MAZE.distance_field(goal, margin=1.0), []
    row, column = map(int, U_MAZE.fine_index(np.array([-4.0, 4.0])))
    while field[row, column] > 0:
        around = [(row + dy, column + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        row, column = min(around, key=lambda cell: float(field[cell]))
        clearance.append(float(U_MAZE.clearance_field[row, column]))
    assert [row, column] == [*map(int, U_MAZE.fine_index(goal))] and 0.9 < min(clearance) < 1.1


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"rows": ("111", "1001", "111")}, "rows: expected strings of one length"),
        ({"rows": ()}, "rows: expected strings of one length"),
        ({"rows": ("111", "1x1", "111")}, "rows: expected 1 for a wall and 0 for free space"),
        ({"start": (0, 1)}, r"start: expected \(row, column\) of a free cell, got \(0, 1\)"),
        ({"goal": (1, 9)}, r"goal: expected \(row, column\) of a free cell, got \(1, 9\)"),
        ({"fine_m": 0.3}, "fine_m: expected a half of the scale, 4.0 m, or a smaller part, got 0.3"),
        *(({"fine_m": wrong}, "fine_m: expected a half of the scale") for wrong in (8.0, 4.0, 0.0)),
    ],
)
def test_a_maze_that_cannot_be_is_refused(changes: dict[str, Any], fault: str) -> None:
    with pytest.raises(BadInputError, match=f"maze: {fault}"):
        replace(CORRIDOR, **changes)


ROOM = Maze(rows=("111", "101", "111"), scale=4.0, start=(1, 1), goal=(1, 1))
"""One room, free in [-2, 2]²; with a radius of 0.1 m, in [-1.9, 1.9]²."""


def slide(maze: Maze, start: list[float], end: list[float]) -> tuple[list[float], bool]:
    rest, stopped = FreeSpace(maze, radius_m=0.1).slide(torch.tensor([start]), torch.tensor([end]))
    return rest[0].tolist(), bool(stopped[0])


@pytest.mark.parametrize(
    ("end", "rest"),
    [
        *(([1.95, 0.0], [1.9, 0.0]), ([-1.95, 0.0], [-1.9, 0.0])),
        *(([0.0, 1.95], [0.0, 1.9]), ([0.0, -1.95], [0.0, -1.9])),
        ([1.95, 1.95], [1.9, 1.9]),  # into a corner
        *(([-1.95, 1.5], [-1.9, 1.5]), ([1.5, -1.95], [1.5, -1.9])),  # slanted: only the blocked axis stops
    ],
)
def test_walls_stop_each_axis_by_itself(end: list[float], rest: list[float]) -> None:
    # Starts within the last free cell, for a step does not look at the cells between its ends.
    start = [float(np.clip(value, -1.85, 1.85)) for value in end]
    reached, stopped = slide(ROOM, start, end)
    assert reached == pytest.approx(rest, abs=2e-4) and stopped
    free = FreeSpace(ROOM, radius_m=0.1)
    column, row = free.cells(torch.tensor(reached))
    assert not free.blocked[row, column]


@pytest.mark.parametrize(("fine_m", "radius_m"), [(0.1, 0.3), (0.1, 0.6), (0.05, 0.35), (0.25, 0.75)])
def test_a_disc_keeps_its_whole_radius_from_walls(fine_m: float, radius_m: float) -> None:
    """Also where a radius is a hair less than its number of cells, as 0.3 / 0.1 is."""
    free = FreeSpace(replace(ROOM, fine_m=fine_m), radius_m=radius_m)
    inside, outside = 2.0 - radius_m - fine_m / 2, 2.0 - radius_m + fine_m / 2
    points = torch.tensor([[inside, 0.0], [0.0, -inside], [outside, 0.0], [0.0, -outside]])
    column, row = free.cells(points).unbind(-1)
    assert free.blocked[row, column].tolist() == [False, False, True, True]


def test_a_start_in_a_blocked_cell_may_leave_but_not_go_deeper() -> None:
    reached, stopped = slide(ROOM, [1.95, 0.0], [1.85, 0.0])  # x = 1.95 is closed; 1.85 is free, 2.05 is deeper
    assert reached == pytest.approx([1.85, 0.0]) and not stopped
    reached, stopped = slide(ROOM, [1.95, 0.0], [2.05, 0.05])
    assert stopped and reached == pytest.approx([2.0, 0.05], abs=2e-4)
    reached, stopped = slide(ROOM, [1.95, 0.0], [1.95, 0.15])  # along the wall it is as deep everywhere
    assert reached == pytest.approx([1.95, 0.15]) and not stopped
    # Out of one wall it does not get into another, not even as deep.
    reached, stopped = slide(ROOM, [1.95, 1.85], [1.85, 1.95])
    assert stopped and reached == pytest.approx([1.85, 1.9], abs=2e-4)


def test_goal_distance_is_bilinear() -> None:
    # A field that is itself linear is reproduced exactly, between cell centers too.
    height, width = ROOM.fine_walls.shape
    half = torch.tensor(ROOM.half_extent, dtype=torch.float32)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x, y = x * ROOM.fine_m - half[0], y * ROOM.fine_m - half[1]
    fields = torch.stack([2 * x - 3 * y, x + y])
    distance = GoalDistance(fields, torch.tensor([[0.0, 0.0], [1.0, 1.0]]), half, ROOM.fine_m)
    position = torch.rand(200, 2, generator=torch.Generator().manual_seed(0)) * 4 - 2
    near = distance(position, torch.tensor([[0.2, 0.1]]).expand(200, 2))
    torch.testing.assert_close(near, 2 * position[:, 0] - 3 * position[:, 1], atol=1e-4, rtol=0)
    far = distance(position, torch.tensor([[0.8, 0.9]]).expand(200, 2))
    torch.testing.assert_close(far, position.sum(-1), atol=1e-4, rtol=0)


def test_goal_distance_follows_the_goal() -> None:
    distance = GoalDistance.of_maze(U_MAZE, spacing_m=0.2)
    goal = torch.tensor([[-4.0, -4.0], [-3.6, -4.0]])
    position = torch.tensor([[0.0, -4.0], [0.0, -4.0]])
    assert distance(position, goal).tolist() == pytest.approx([4.0, 3.6], abs=0.1)
    # As far as three standard deviations of a goal that is drawn, to either side.
    corners = torch.tensor([[-4.6, -4.6], [-3.4, -3.4]])
    assert distance(corners, corners).tolist() == pytest.approx([0.0, 0.0], abs=0.1)
