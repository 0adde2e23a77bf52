from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from astra_data.core.errors import BadInputError
from astra_data.worlds.plane.mazes import LONG_MAZE, U_MAZE, Maze

CORRIDOR = Maze(rows=("1111111", "1000001", "1111111"), scale=4.0, start=(1, 1), goal=(1, 5))


def shortest(maze: Maze, start: tuple[float, float], goal: tuple[float, float]) -> float:
    return float(maze.distance_field(np.array(goal))[maze.fine_index(np.array(start))])


def test_the_long_maze_is_the_u_maze_twice() -> None:
    assert LONG_MAZE.rows[:5] == (*U_MAZE.rows[:4], "10111")
    assert LONG_MAZE.cell_center(*LONG_MAZE.start) == (-4.0, 8.0)
    assert LONG_MAZE.cell_center(*LONG_MAZE.goal) == (4.0, -8.0)


def test_cells_and_points_agree() -> None:
    centers = U_MAZE.free_centers()
    assert len(centers) == len(U_MAZE.free_cells()) == 7
    assert (U_MAZE.clearance(centers) > 1.9).all()
    walls = np.array([U_MAZE.cell_center(*cell) for cell in U_MAZE.wall_cells()])
    assert len(walls) == 25 - 7
    assert not U_MAZE.clearance(walls).any()
    assert not U_MAZE.clearance(np.array([[100.0, 0.0], [0.0, -100.0]])).any()


def test_the_fine_grid_repeats_the_walls() -> None:
    points = np.random.default_rng(0).uniform(-9.9, 9.9, (500, 2))
    centers = np.array([U_MAZE.cell_center(row, column) for row in range(5) for column in range(5)])
    nearest = np.abs(points[:, None] - centers).max(axis=-1).argmin(axis=1)
    assert (U_MAZE.fine_walls[U_MAZE.fine_index(points)] == U_MAZE.walls.ravel()[nearest]).all()


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


def test_clearance_in_the_middle_and_beside_a_wall() -> None:
    points = np.array([[0.0, 4.0], [0.0, 5.5], [0.0, 4.0 + 1.75], [0.0, 0.0]])
    assert U_MAZE.clearance(points) == pytest.approx([2.0, 0.5, 0.25, 0.0], abs=U_MAZE.fine_m)


@pytest.mark.parametrize(
    ("start", "goal", "length"),
    [
        ((-8.0, 0.0), (8.0, 0.0), 16.0),  # along the corridor
        ((-8.0, -1.0), (8.0, 1.0), np.hypot(16.0, 2.0)),  # across it
        ((-8.0, -1.5), (-5.0, 1.5), np.hypot(3.0, 3.0)),  # diagonally
    ],
)
def test_distance_along_a_straight_corridor(
    start: tuple[float, float], goal: tuple[float, float], length: float
) -> None:
    assert shortest(CORRIDOR, start, goal) == pytest.approx(length, rel=0.03)


def test_distance_around_the_u() -> None:
    # The U's inner wall ends in the corners (2, 2) and (2, -2): two slanted legs and its end between them.
    length = 2 * np.hypot(6.0, 2.0) + 4.0
    assert shortest(U_MAZE, (-4.0, 4.0), (-4.0, -4.0)) == pytest.approx(length, rel=0.03)


def test_distance_in_a_wall_grows_inward() -> None:
    field = U_MAZE.distance_field(np.array([-4.0, -4.0]))
    depths = [field[U_MAZE.fine_index(np.array([-8.0 + offset, -4.0]))] for offset in (1.95, 1.45, 0.95)]
    assert depths == pytest.approx([2.05, 2.55, 3.05], rel=0.05)


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


def test_a_margin_keeps_paths_away_from_corners() -> None:
    goal, start = np.array([-4.0, -4.0]), U_MAZE.fine_index(np.array([-4.0, 4.0]))
    wide = U_MAZE.distance_field(goal, margin=1.0)
    # Past the corners at 1 m, a path is longer, and nowhere shorter than the free one.
    assert wide[start] > 1.02 * U_MAZE.distance_field(goal)[start]
    assert wide[start] < 2 * np.hypot(6.0, 3.0) + 6.0 + 1.0


def test_who_goes_downhill_keeps_the_margin_all_the_way() -> None:
    goal = np.array([-4.0, -4.0])
    field, clearance = U_MAZE.distance_field(goal, margin=1.0), []
    row, column = map(int, U_MAZE.fine_index(np.array([-4.0, 4.0])))
    while field[row, column] > 0:
        around = [(row + dy, column + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        row, column = min(around, key=lambda cell: float(field[cell]))
        clearance.append(float(U_MAZE.clearance_field[row, column]))
    assert [row, column] == [*map(int, U_MAZE.fine_index(goal))]
    assert 0.9 < min(clearance) < 1.1


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"rows": ("111", "1001", "111")}, "rows: expected strings of one length"),
        ({"rows": ()}, "rows: expected strings of one length"),
        ({"rows": ("111", "1x1", "111")}, "rows: expected 1 for a wall and 0 for free space"),
        ({"start": (0, 1)}, r"start: expected \(row, column\) of a free cell, got \(0, 1\)"),
        ({"goal": (1, 9)}, r"goal: expected \(row, column\) of a free cell, got \(1, 9\)"),
        ({"rows": ("1111111", "1001001", "1111111")}, "goal: expected a cell to which a way leads from the"),
        ({"rows": ("1111", "1011", "1101", "1111"), "goal": (2, 2)}, r"goal: .* the start, got \(2, 2\)"),
        ({"fine_m": 0.3}, "fine_m: expected a half of the scale, 4.0 m, or a smaller part, got 0.3"),
        ({"fine_m": 8.0}, "fine_m: expected a half of the scale"),
        ({"fine_m": 4.0}, "fine_m: expected a half of the scale"),
        ({"fine_m": 0.0}, "fine_m: expected a half of the scale"),
    ],
)
def test_a_maze_that_cannot_be_is_refused(changes: dict[str, Any], fault: str) -> None:
    with pytest.raises(BadInputError, match=f"maze: {fault}"):
        replace(CORRIDOR, **changes)


@pytest.mark.parametrize("ends", [((1, 1), (1, 3)), ((1, 3), (1, 1))])
def test_a_way_may_lead_down_and_up_again(ends: tuple[tuple[int, int], tuple[int, int]]) -> None:
    rows = ("11111", "10101", "10001", "11111")
    assert Maze(rows=rows, scale=1.0, start=ends[0], goal=ends[1]).walls.sum() == 15


def test_every_fault_of_a_maze_is_told_at_once() -> None:
    faults = r"maze: start: expected .* got \(0, 0\); goal: expected .* got \(9, 9\); fine_m: expected a half"
    with pytest.raises(BadInputError, match=faults):
        replace(CORRIDOR, start=(0, 0), goal=(9, 9), fine_m=3.0)


@pytest.mark.parametrize(("scale", "fine_m"), [(0.0, 0.1), (-4.0, -0.1), (-4.0, 0.1)])
def test_cells_have_a_size(scale: float, fine_m: float) -> None:
    with pytest.raises(BadInputError, match="maze: fine_m: expected a half of the scale"):
        replace(CORRIDOR, scale=scale, fine_m=fine_m)


def test_cells_of_a_maze_that_is_not_square_are_where_they_are_drawn() -> None:
    assert CORRIDOR.half_extent.tolist() == [14.0, 6.0]
    assert (CORRIDOR.cell_center(0, 0), CORRIDOR.cell_center(1, 5)) == ((-12.0, 4.0), (8.0, 0.0))
    assert CORRIDOR.fine_walls.shape == (120, 280)


def test_a_room_that_is_closed_off_is_as_far_as_a_wall() -> None:
    maze = Maze(rows=("1111111", "1000101", "1111111"), scale=1.0, start=(1, 1), goal=(1, 1))
    field = maze.distance_field(np.array(maze.cell_center(1, 1)))
    row, columns = 15, np.array([35, 45, 55])  # middles of the last cell of the corridor, the wall, the room
    assert np.isfinite(field).all()
    # From the goal to the corridor's last cell, then straight on.
    np.testing.assert_allclose(field[row, columns], [2.0, 3.0, 4.0], atol=0.11)


def test_there_is_no_distance_to_a_goal_in_a_wall() -> None:
    with pytest.raises(BadInputError, match=r"farther than 0.5 m from walls, got \(8.00, 1.60\)"):
        CORRIDOR.distance_field(np.array([8.0, 1.6]), radius=0.5)
    assert np.isfinite(CORRIDOR.distance_field(np.array([8.0, 1.6]), radius=0.3)).all()
