"""What simulated targets in a maze share, on robots that are a position each."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from astra_data.robots.nao.kicking import Kicking
from astra_data.worlds.plane.mazes import FIELD, U_MAZE
from astra_data.worlds.plane.navigation import Navigation, PlanarTarget
from astra_data.worlds.protocols import Step


class Straight(Navigation):
    """Progress is paid as the crow flies."""

    def progress(self, before: Tensor, after: Tensor, goal: Tensor) -> Tensor:
        return torch.pairwise_distance(before[:, :2], goal, eps=0) - torch.pairwise_distance(
            after[:, :2], goal, eps=0
        )


TASK = Straight(U_MAZE, horizon=10)
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


def judged(
    target: PlanarTarget, after: Sequence[Sequence[float]], fallen: Sequence[bool] = (False,) * 3
) -> Step:
    """Return the outcome of a step from the origin, whose goals are at (1, 0)."""
    target.goal = torch.tensor([[1.0, 0.0]] * 3)
    return target._judged(torch.zeros(3, 2), torch.tensor(after), np.array(fallen))


def test_robots_start_and_aim_where_the_task_does() -> None:
    target = Dots(TASK, 3)
    target.reseed(5)
    rows = np.array([2, 0])
    starts = target._start(rows)
    target._aim(rows)
    assert starts.shape == (2, 4)
    # Three standard deviations of 0.2 m at most.
    assert (np.abs(starts[:, :2] - START) <= 0.6).all() and not starts[:, 2:].any()
    assert (np.abs(target.goal[rows].numpy() - GOAL) <= 0.6).all()
    assert target.goal[1].tolist() == [0.0, 0.0]  # who is not asked keeps its goal
    target.reseed(5)
    np.testing.assert_array_equal(target._start(rows), starts)
    assert not np.array_equal(target._start(rows), starts)


def test_robots_start_anywhere() -> None:
    anywhere = Dots(TASK, 3, start_anywhere=True)
    anywhere.reseed(0)
    starts = anywhere._start(np.arange(3).repeat(100))[:, :2]
    assert (U_MAZE.clearance(starts) > 0.8).all()
    assert np.ptp(starts, axis=0).min() > 4.0  # more than a cell along each axis


def test_an_episode_ends_at_the_goal_or_in_a_fall() -> None:
    target = Dots(TASK, 3)
    step = judged(target, [[0.9, 0.0], [0.2, 0.0], [0.3, 0.0]], (False, True, False))
    assert step.success.tolist() == [True, False, False]
    assert target.failed.tolist() == [False, True, False]
    assert step.terminated.tolist() == [True, True, False]
    # Meters closer to the goal, and 10 for reaching it or -10 for the fall.
    torch.testing.assert_close(step.reward, torch.tensor([10.9, 0.2 - 10.0, 0.3]))
    assert step.observation.tolist() == [[0.0, 0.0, 1.0, 0.0]] * 3


def test_who_reaches_the_goal_has_not_failed() -> None:
    for objective in (TASK, WALLED):
        target = Dots(objective, 3)
        step = judged(target, [[1.0, 0.0]] * 3, (True, True, False))
        assert step.success.all() and step.terminated.all() and not target.failed.any()
        torch.testing.assert_close(step.reward, torch.full((3,), 11.0))


@pytest.mark.parametrize(("objective", "failed"), [(TASK, [False] * 3), (WALLED, [True, False, False])])
def test_walls_end_an_episode_where_the_objective_says_so(objective: Navigation, failed: list[bool]) -> None:
    target = Dots(objective, 3)
    step = judged(target, [[0.5, 0.0]] * 3)
    assert target.failed.tolist() == step.terminated.tolist() == failed
    torch.testing.assert_close(step.reward, 0.5 - 10.0 * torch.tensor(failed).float())


def test_a_ball_that_is_out_ends_an_episode() -> None:
    field = Kicking(FIELD, horizon=10)
    target = Dots(field, 3)
    # In the goal, beside it, and on the field.
    after = torch.zeros(3, 8)
    after[:, 4:6] = torch.tensor([[1.6, 0.0], [1.6, 1.0], [1.0, 0.0]])
    target.goal = torch.tensor([[1.5, 0.0]] * 3)
    step = target._judged(torch.zeros(3, 8), after, np.zeros(3, dtype=bool))
    assert step.success.tolist() == [True, False, False]
    assert target.failed.tolist() == [False, True, False]
    assert step.terminated.tolist() == [True, True, False]
