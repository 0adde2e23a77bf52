import numpy as np
import pytest
import torch

from astra_data.robots.nao.kicking import Kicking
from astra_data.worlds.plane.mazes import FIELD

TASK = Kicking(FIELD, horizon=156)
GOAL = torch.tensor([[1.5, 0.0]])


def state(robot: tuple[float, float], ball: tuple[float, float]) -> torch.Tensor:
    return torch.tensor([[*robot, 0.0, 0.0, *ball, 0.0, 0.0]])


def test_starts_are_where_the_task_says() -> None:
    starts = TASK.draw_starts(np.random.default_rng(0), 4000)
    robot, ball = starts[:, :2], starts[:, 4:6]
    assert starts.shape == (4000, 8)
    assert (starts[:, 2:4] == 0).all()
    assert (starts[:, 6:] == 0).all()
    assert ball.min(axis=0) == pytest.approx([-0.5, -0.6], abs=0.01)
    assert ball.max(axis=0) == pytest.approx([0.0, 0.6], abs=0.01)
    assert (np.abs(robot) <= 1.9).all()
    apart = np.linalg.norm(robot - ball, axis=1)
    assert apart.min() >= 0.4 - 1e-9
    assert apart.max() <= 1.0 + 1e-9
    # All around the ball.
    to_goal = np.array([1.5, 0.0]) - ball
    ahead = ((robot - ball) * to_goal).sum(axis=1) > 0
    assert ahead.mean() == pytest.approx(0.5, abs=0.03)


def test_recorded_episodes_begin_near_the_ball() -> None:
    starts = TASK.draw_anywhere(np.random.default_rng(0), 4000)
    apart = np.linalg.norm(starts[:, :2] - starts[:, 4:6], axis=1)
    assert apart.min() == pytest.approx(0.18, abs=0.01)
    assert apart.max() == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("ball", "reached", "missed"),
    [
        ((1.49, 0.0), False, False),
        ((1.5, 0.74), True, False),
        ((1.8, 0.76), False, True),
        ((0.0, 2.01), False, True),
        ((0.0, -2.01), False, True),
        ((-2.01, 0.0), False, True),
        ((-1.99, 1.99), False, False),
        ((1.6, -0.74), True, False),
        ((1.6, -0.76), False, True),
        # Lines belong to the field, posts and goal line to the goal.
        ((1.5, 0.75), True, False),
        ((1.5, 1.0), False, True),
        ((-2.0, 2.0), False, False),
        ((0.0, -2.0), False, False),
    ],
)
def test_a_ball_is_in_the_goal_in_the_field_or_out(
    ball: tuple[float, float], reached: bool, missed: bool
) -> None:
    where = state((0.0, 0.0), ball)
    assert bool(TASK.reached(where, GOAL)) == reached
    assert bool(TASK.missed(where, GOAL)) == missed


def test_rewards_are_meters_gained_and_the_outcome() -> None:
    before, after = state((-1.0, 0.0), (0.0, 0.0)), state((-0.75, 0.0), (0.5, 0.0))
    none = torch.zeros(1, dtype=torch.bool)
    # The ball gains 0.5 m; the place behind it moved 0.5 m away, the robot 0.25 m on.
    assert TASK.reward(before, after, GOAL, none).item() == pytest.approx(0.5 - 0.5 * 0.25, abs=1e-5)
    assert TASK.reward(before, before, GOAL, ~none).item() == pytest.approx(-10.0)
    scored = state((1.0, 0.0), (1.5, 0.0))
    assert TASK.reward(scored, scored, GOAL, none).item() == pytest.approx(10.0)


def test_policies_are_shown_everything_that_matters() -> None:
    states = torch.randn(3, 5, 8)
    goals = GOAL.expand(3, 5, 2)
    seen = TASK.observe(states, goals)
    assert seen.shape == (3, 5, 14)
    moved = states.clone()
    moved[..., 4] += 0.1
    assert (TASK.observe(moved, goals) != seen).any(-1).all()


def test_they_see_it_in_these_units() -> None:
    seen_from = torch.tensor([0.2, 0.4, 0.1, -0.1, 0.5, 0.0, 0.6, -0.2])
    seen = TASK.observe(seen_from.expand(2, 3, 8), GOAL.expand(2, 3, 2))
    # Half of positions and of the ball's way to the goal; four times the velocity; the ball's velocity; four
    # times the way to the ball, and to the point 0.2 m behind it on the line from the goal.
    expected = [0.1, 0.2, 0.25, 0.0, 0.5, 0.0, 0.4, -0.4, 0.6, -0.2, 4 * 0.3, 4 * -0.4, 4 * 0.1, 4 * -0.4]
    torch.testing.assert_close(seen, torch.tensor(expected).expand(2, 3, 14))


def test_the_point_behind_the_ball_attracts_the_robot() -> None:
    none = torch.zeros(1, dtype=torch.bool)
    # The ball at (0.5, 1) is sqrt(2) m from the goal; the point behind it 0.2 m further, up and to the left.
    behind = (0.5 - 0.2 * 0.5**0.5, 1.0 + 0.2 * 0.5**0.5)
    away = (behind[0] + 0.3, behind[1] + 0.4)
    before, after = state(away, (0.5, 1.0)), state(behind, (0.5, 1.0))
    assert TASK.reward(before, after, GOAL, none).item() == pytest.approx(0.5 * 0.5, abs=1e-5)


def test_a_speed_limit_leaves_the_wish_to_kick_as_it_is() -> None:
    limited = TASK.limit_command(torch.tensor([[0.6, 0.8, 0.9], [0.0, 0.1, -3.0]]), 0.5)
    torch.testing.assert_close(limited, torch.tensor([[0.3, 0.4, 0.9], [0.0, 0.1, -1.0]]))
