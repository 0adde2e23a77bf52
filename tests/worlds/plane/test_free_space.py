from dataclasses import replace

import numpy as np
import pytest
import torch

from astra_data.worlds.plane.mazes import U_MAZE, FreeSpace, GoalDistance, Maze

ROOM = Maze(rows=("111", "101", "111"), scale=4.0, start=(1, 1), goal=(1, 1))
"""One room, free in [-2, 2]²; with a radius of 0.1 m, in [-1.9, 1.9]²."""

PILLAR = Maze(rows=("11111", "10001", "10101", "10001", "11111"), scale=2.0, start=(1, 1), goal=(3, 3))
"""A corridor around a block that is closed in [-1.1, 1.1]² with a radius of 0.1 m."""


def slide(maze: Maze, start: list[float], end: list[float]) -> tuple[list[float], bool]:
    rest, stopped = FreeSpace.of_maze(maze, radius_m=0.1).slide(torch.tensor([start]), torch.tensor([end]))
    return rest[0].tolist(), bool(stopped[0])


@pytest.mark.parametrize(
    ("end", "rest"),
    [
        ([1.95, 0.0], [1.9, 0.0]),
        ([-1.95, 0.0], [-1.9, 0.0]),
        ([0.0, 1.95], [0.0, 1.9]),
        ([0.0, -1.95], [0.0, -1.9]),
        ([1.95, 1.95], [1.9, 1.9]),  # into a corner
        ([-1.95, 1.5], [-1.9, 1.5]),  # slanted: only the blocked axis stops
        ([1.5, -1.95], [1.5, -1.9]),
    ],
)
def test_walls_stop_each_axis_by_itself(end: list[float], rest: list[float]) -> None:
    # Starts within the last free cell, for a step does not look at the cells between its ends.
    start = [float(np.clip(value, -1.85, 1.85)) for value in end]
    reached, stopped = slide(ROOM, start, end)
    assert reached == pytest.approx(rest, abs=2e-4)
    assert stopped
    free = FreeSpace.of_maze(ROOM, radius_m=0.1)
    assert not free.blocked[free.cells(torch.tensor(reached))]


def test_free_motion_is_exact() -> None:
    reached, stopped = slide(ROOM, [0.3, -0.2], [0.35, -0.25])
    assert reached == pytest.approx([0.35, -0.25])
    assert not stopped


def test_an_outer_corner_met_diagonally_lets_one_axis_pass() -> None:
    # From below and left of the pillar's corner at (-1.1, -1.1): x goes first and is free, then y is stopped.
    reached, stopped = slide(PILLAR, [-1.12, -1.12], [-1.08, -1.08])
    assert reached == pytest.approx([-1.08, -1.1], abs=2e-4)
    assert stopped


@pytest.mark.parametrize(("fine_m", "radius_m"), [(0.1, 0.3), (0.1, 0.6), (0.05, 0.35), (0.25, 0.75)])
def test_a_disc_keeps_its_whole_radius_from_walls(fine_m: float, radius_m: float) -> None:
    """Also where a radius is a hair less than its number of cells, as 0.3 / 0.1 is."""
    free = FreeSpace.of_maze(replace(ROOM, fine_m=fine_m), radius_m=radius_m)
    inside, outside = 2.0 - radius_m - fine_m / 2, 2.0 - radius_m + fine_m / 2
    points = torch.tensor([[inside, 0.0], [0.0, -inside], [outside, 0.0], [0.0, -outside]])
    assert free.blocked[free.cells(points)].tolist() == [False, False, True, True]


def test_discs_of_one_size_share_a_grid_but_are_no_single_space() -> None:
    first, again, wider = (FreeSpace.of_maze(U_MAZE, radius_m=radius_m) for radius_m in (0.5, 0.5, 0.9))
    assert first.blocked is again.blocked and first is not again
    assert wider.blocked.sum() > first.blocked.sum()


def test_a_long_walk_never_leaves_the_free_space() -> None:
    free = FreeSpace.of_maze(U_MAZE, radius_m=0.1)
    generator = torch.Generator().manual_seed(0)
    position = torch.tensor(U_MAZE.free_centers(), dtype=torch.float32).repeat(20, 1)
    heading = torch.randn(position.shape, generator=generator)
    for _ in range(100):
        heading = heading + 0.1 * torch.randn(position.shape, generator=generator)
        position, _ = free.slide(position, position + 0.08 * torch.nn.functional.normalize(heading))
        assert not free.blocked[free.cells(position)].any()


def test_a_start_in_a_blocked_cell_may_leave_but_not_go_deeper() -> None:
    # x = 1.95 is closed; 1.85 is free, 2.05 is deeper.
    reached, stopped = slide(ROOM, [1.95, 0.0], [1.85, 0.0])
    assert reached == pytest.approx([1.85, 0.0])
    assert not stopped
    reached, stopped = slide(ROOM, [1.95, 0.0], [2.05, 0.05])
    assert stopped
    assert reached == pytest.approx([2.0, 0.05], abs=2e-4)
    # Along the wall it is as deep everywhere.
    reached, stopped = slide(ROOM, [1.95, 0.0], [1.95, 0.15])
    assert reached == pytest.approx([1.95, 0.15])
    assert not stopped
    # Out of one wall it does not get into another, not even as deep.
    reached, stopped = slide(ROOM, [1.95, 1.85], [1.85, 1.95])
    assert stopped
    assert reached == pytest.approx([1.85, 1.9], abs=2e-4)


def test_the_edge_of_a_maze_without_outer_walls_stops_a_disc_too() -> None:
    floor = Maze(rows=("000",) * 3, scale=1.0, start=(0, 0), goal=(2, 2))
    reached, stopped = slide(floor, [1.35, -1.35], [1.45, -1.45])
    assert stopped
    assert reached == pytest.approx([1.4, -1.4], abs=2e-4)


def test_a_wall_cannot_be_walked_through_from_inside() -> None:
    free = FreeSpace.of_maze(U_MAZE, radius_m=0.1)
    position = torch.tensor([[-4.0, 1.95]])  # just inside the wall between the arms, which is 4 m thick
    for _ in range(200):
        position, _ = free.slide(position, position + torch.tensor([[0.0, -0.05]]))
    assert position[0, 1] > 1.8


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


@pytest.mark.parametrize(
    ("rows", "goal"), [(("11111", "10001", "11111"), (1, 1)), (("111", "101", "101", "101", "111"), (3, 1))]
)
def test_goal_distance_in_a_maze_that_is_not_square(rows: tuple[str, ...], goal: tuple[int, int]) -> None:
    maze = Maze(rows=rows, scale=1.0, start=goal, goal=goal)
    distance = GoalDistance.of_maze(maze, spacing_m=0.1)
    here = torch.tensor([maze.cell_center(*goal)])
    assert distance(-here, here).tolist() == pytest.approx([2.0], abs=0.1)


def test_points_outside_of_the_maze_have_the_values_of_its_edge() -> None:
    distance = GoalDistance.of_maze(U_MAZE, spacing_m=0.2)
    goal = torch.tensor([U_MAZE.cell_center(*U_MAZE.goal)]).expand(4, 2)
    outside = torch.tensor([[-4.0, 15.0], [-4.0, -15.0], [-15.0, 4.0], [15.0, 4.0]])
    edge = outside.clamp(-9.95, 9.95)
    torch.testing.assert_close(distance(outside, goal), distance(edge, goal), atol=0.01, rtol=0)
    space = FreeSpace.of_maze(U_MAZE, radius_m=0.1)
    assert space.blocked[space.cells(outside)].all()
