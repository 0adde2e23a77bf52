from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.worlds.plane.mazes import LONG_MAZE, U_MAZE, Maze
from astra_data.worlds.plane.navigation import Navigation, PlanarTarget
from astra_data.worlds.protocols import Step

TASK = Navigation(U_MAZE, horizon=700)


def along(corners: list[list[float]], count: int) -> Tensor:
    """Return `count` points (count, 2) along a line through `corners`."""
    places = np.linspace(0, len(corners) - 1, count)
    columns = [np.interp(places, range(len(corners)), column) for column in zip(*corners, strict=True)]
    return torch.tensor(np.stack(columns, axis=-1), dtype=torch.float32)


def test_progress_adds_up_to_the_distance_gained() -> None:
    path = along([[-4, 4], [4, 4], [4, -4], [0, -4]], 120)
    goal = torch.tensor([[-4.0, -4.0]]).expand(119, 2)
    gained = TASK.progress(path[:-1], path[1:], goal).sum()
    # From two slanted legs around the inner wall's end to the last 4 m.
    assert float(gained) == pytest.approx(2 * np.hypot(6, 2) + 4 - 4, rel=0.04)


def test_success_and_toppling_are_paid_once_each() -> None:
    goal = torch.tensor([[-4.0, -4.0]]).expand(4, 2)
    position = goal + torch.tensor([[0.44, 0.0], [0.46, 0.0], [0.46, 0.0], [0.0, 0.46]])
    toppled = torch.tensor([False, False, True, False])
    assert TASK.reached(position, goal).tolist() == [True, False, False, False]
    reward = TASK.reward(position, position, goal, toppled)
    assert reward.tolist() == pytest.approx([10.0, 0.0, -10.0, 0.0], abs=1e-5)
    rim = goal[:1] + torch.tensor([[0.0, 0.5]])
    assert Navigation(U_MAZE, horizon=700, success_radius_m=0.5).reached(rim, goal[:1]).all()


def test_policies_see_shares_of_the_half_extent_and_waves_of_the_position() -> None:
    goal = torch.tensor([[-4.0, -4.0]]).expand(2, 2)
    state = torch.tensor([[5.0, 2.5, 0.0, 0.0], [-10.0, 10.0, 0.0, 0.0]])
    seen = Navigation(U_MAZE, horizon=700, position_waves=2).observe(state, goal)
    assert torch.equal(seen[:, :8], TASK.observe(state, goal))
    torch.testing.assert_close(seen[0, :8], torch.tensor([0.5, 0.25, 0.0, 0.0, -0.4, -0.4, -0.9, -0.65]))
    # The maze reaches from -10 to 10 m: a quarter and an eighth of a wave, then twice as much.
    sines, cosines = seen[0, 8:12].tolist(), seen[0, 12:].tolist()
    assert sines == pytest.approx([1.0, 0.5**0.5, 0.0, 1.0], abs=1e-6)
    assert cosines == pytest.approx([0.0, 0.5**0.5, -1.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("maze", [U_MAZE, LONG_MAZE])
def test_starts_and_goals_scatter_around_their_cells(maze: Maze) -> None:
    task = Navigation(maze, horizon=1)
    for draw, cell in ((task.draw_starts, task.maze.start), (task.draw_goals, task.maze.goal)):
        points = draw(np.random.default_rng(0), 4000)[:, :2] - np.array(task.maze.cell_center(*cell))
        assert points.shape == (4000, 2) and points.mean(axis=0) == pytest.approx([0.0, 0.0], abs=0.02)
        assert points.std(axis=0) == pytest.approx([0.2, 0.2], abs=0.01) and np.abs(points).max() <= 0.6 + 1e-9


def test_goals_have_to_be_within_their_cell() -> None:
    narrow = replace(U_MAZE, scale=1.0)
    with pytest.raises(BadInputError, match=r"3 spread_m \+ path_clearance_m = 0.6 m around its center"):
        Navigation(narrow, horizon=1)
    with pytest.raises(BadInputError, match=r"goals within their cell of 1 m, got .* = 0.5 m"):
        Navigation(narrow, horizon=1, spread_m=0.1, path_clearance_m=0.2)
    distance = Navigation(narrow, horizon=1, spread_m=0.11, path_clearance_m=0.1).goal_distance
    rows, columns = narrow.fine_index(distance.lattice.double().numpy())
    # Each field is least at its own goal.
    assert [divmod(int(field.argmin()), 50) for field in distance.fields] == [*zip(rows, columns, strict=True)]


def test_paths_to_the_goal_keep_the_clearance() -> None:
    maze = replace(U_MAZE, scale=1.0, fine_m=0.05)
    distance = Navigation(maze, horizon=1, spread_m=0.05, path_clearance_m=0.25).goal_distance
    start, goal = (torch.tensor([maze.cell_center(*cell)]) for cell in (maze.start, maze.goal))
    # Along tangents of circles of 0.25 m around the inner wall's corners, which are 1 m apart.
    away = np.hypot(1.5, 0.5)
    bend = np.pi / 2 - np.arctan(0.5 / 1.5) + np.arcsin(0.25 / away)
    expected = 2 * np.sqrt(away**2 - 0.25**2) + 2 * 0.25 * bend + 1.0
    assert float(distance(start, goal)) == pytest.approx(expected, rel=0.04)


def test_starts_anywhere_cover_the_free_space_evenly_and_keep_clear_of_walls() -> None:
    points = TASK.draw_anywhere(np.random.default_rng(0), 7000)[:, :2]
    assert U_MAZE.clearance(points).min() > 0.8
    # The two arms are mirror images.
    assert (points[:, 1] > 0).mean() == pytest.approx(0.5, abs=0.02)
    arms = (np.abs(points[:, 1]) > 2).mean()
    # Arms of 10.4 m by 2.4 m (2 of them), and 5.6 m by 2.4 m of bend between them.
    assert arms == pytest.approx(2 * 10.4 * 2.4 / (2 * 10.4 * 2.4 + 4 * 2.4), abs=0.03)


class Straight(Navigation):
    """Progress is paid as the crow flies."""

    def progress(self, before: Tensor, after: Tensor, goal: Tensor) -> Tensor:
        return torch.pairwise_distance(before[:, :2], goal, eps=0) - torch.pairwise_distance(after[:, :2], goal, eps=0)


STRAIGHT = Straight(U_MAZE, horizon=10)
WALLED = Straight(U_MAZE, horizon=10, ends_at_walls=True)
START, GOAL = (np.array(U_MAZE.cell_center(*cell)) for cell in (U_MAZE.start, U_MAZE.goal))


class Dots(PlanarTarget):
    """Robots [x, y], the first of which leans on a wall."""

    place = torch.zeros(3, 2)

    @property
    def state(self) -> Tensor:
        return self.place

    @property
    def wall_contact(self) -> Tensor:
        return torch.tensor([True, False, False])


def judged(target: PlanarTarget, after: Sequence[Sequence[float]], fallen: Sequence[bool] = (False,) * 3) -> Step:
    """Return the outcome of a step from the origin, whose goals are at (1, 0)."""
    target.goal = torch.tensor([[1.0, 0.0]] * 3)
    return target._judged(torch.zeros(3, 2), torch.tensor(after), np.array(fallen))


def test_an_episode_ends_at_the_goal_or_in_a_fall() -> None:
    target = Dots(STRAIGHT, 3)
    step = judged(target, [[0.9, 0.0], [0.2, 0.0], [0.3, 0.0]], (False, True, False))
    assert step.success.tolist() == [True, False, False] and target.failed.tolist() == [False, True, False]
    assert step.terminated.tolist() == [True, True, False]
    # Meters closer to the goal, and 10 for reaching it or -10 for the fall.
    torch.testing.assert_close(step.reward, torch.tensor([10.9, 0.2 - 10.0, 0.3]))
    assert step.observation.tolist() == [[0.0, 0.0, 1.0, 0.0]] * 3


@pytest.mark.parametrize(("objective", "failed"), [(STRAIGHT, [False] * 3), (WALLED, [True, False, False])])
def test_walls_end_an_episode_where_the_objective_says_so(objective: Navigation, failed: list[bool]) -> None:
    target = Dots(objective, 3)
    step = judged(target, [[0.5, 0.0]] * 3)
    assert target.failed.tolist() == step.terminated.tolist() == failed
    torch.testing.assert_close(step.reward, 0.5 - 10.0 * torch.tensor(failed).float())
    assert judged(target, [[0.9, 0.0]] * 3).success.all() and not target.failed.any()  # at the goal, by a wall
