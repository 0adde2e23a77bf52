from typing import Any

import numpy as np
import pytest
import torch

from astra_data.robots.nao import kicking
from astra_data.worlds.plane.mazes import FIELD
from astra_data.worlds.plane.navigation import VariedPlanar
from astra_data.worlds.variation import BallVariation


def test_a_ball_rolls_as_even_friction_has_it_whatever_the_steps() -> None:
    position, velocity = torch.zeros(1, 2), torch.tensor([[0.6, 0.8]])
    for _ in range(10):
        position, velocity = kicking.roll(position, velocity, 0.1, kicking.ROLLING_M_S2)
    # v0 t - a t² / 2 after 1 s, along (0.6, 0.8).
    assert position[0].tolist() == pytest.approx([0.6 * 0.85, 0.8 * 0.85], abs=1e-5)
    assert velocity[0].tolist() == pytest.approx([0.6 * 0.7, 0.8 * 0.7], abs=1e-5)


def test_a_body_knocks_its_ball_away_along_the_line_between_them() -> None:
    before, after = torch.tensor([[0.0, 0.0]]), torch.tensor([[0.1, 0.0]])
    ball = torch.tensor([[0.2, 0.1]])
    place, velocity = kicking.knock(before, after, ball, torch.zeros(1, 2), kicking.Contact(0.19, 0.7))
    diagonal = 0.5**0.5
    assert velocity[0].tolist() == pytest.approx([0.7 * diagonal, 0.7 * diagonal], abs=1e-6)
    assert place[0].tolist() == pytest.approx([0.1 + 0.19 * diagonal, 0.19 * diagonal], abs=1e-6)
    beside, turned = kicking.knock(before, after, ball, torch.zeros(1, 2), kicking.Contact(0.19, 0.7, torch.pi / 4))
    # It begins where the body touches it, whichever way it leaves.
    assert torch.equal(kicking.knock(after, after, ball, ball, kicking.Contact(0.19, 0.7))[0], ball)  # it stands
    assert torch.equal(beside, place) and turned[0].tolist() == pytest.approx([0.0, 0.7], abs=1e-6)


def test_balls_within_reach_leave_straight_away_or_turned_and_more_than_a_half_asks_for_it() -> None:
    ball = torch.tensor([[0.18, 0.24], [0.3, 0.4], [-0.3, 0.0]])
    assert kicking.asks_to_kick(torch.tensor([[0.9, 0.9, 0.6], [0.9, 0.9, 0.5]])).tolist() == [[True], [False]]
    for turn_rad, expected in ((0.0, [1.2, 1.6]), (torch.full((3,), torch.pi / 2), [-1.6, 1.2])):
        _, within, leaving = kicking.Contact(0.35, 2.0, turn_rad).of(torch.zeros(3, 2), ball)
        assert within[:, 0].tolist() == [True, False, True] and leaving[0].tolist() == pytest.approx(expected)


BODY: dict[str, Any] = {"timestep_s": 0.2, "radius_m": 0.2, "speed_m_s": 0.25}
CONTACT: dict[str, Any] = {"reach_m": 0.19, "knock_m_s": 1.0, "kick_reach_m": 0.3, "kick_m_s": 1.5}
AHEAD = torch.tensor([[1.0, 0.0, 0.0]])
STAY = torch.zeros(1, 3)
START = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.22, 0.0, 0.0, 0.0]])


def one(count: int = 1) -> kicking.BallAgent:
    simulator = kicking.BallAgent(FIELD, count, **BODY, **CONTACT)
    simulator.reset_to(START.expand(count, 8))
    return simulator


def test_it_walks_into_its_ball() -> None:
    simulator = one()
    state = simulator.step(AHEAD)
    way = 1.0 * 0.2 - 0.3 * 0.2**2 / 2  # the ball leaves at 1 m/s from 0.19 m ahead of 0.05 m, and rolls for 0.2 s
    expected = [0.05, 0.0, 0.25, 0.0, 0.05 + 0.19 + way, 0.0, 1.0 - 0.3 * 0.2, 0.0]
    assert state[0].tolist() == pytest.approx(expected, abs=1e-5)
    for _ in range(100):
        state = simulator.step(STAY)
    assert state[0, 4].item() == pytest.approx(0.24 + 1.0 / 0.6, abs=1e-4) and state[0, 6:].abs().max() == 0


def test_it_stands_and_kicks() -> None:
    simulator = one(2)
    simulator.reset_to(torch.cat([START, START + torch.tensor([0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0])]))
    state = simulator.step(torch.tensor([[1.0, 0.0, 1.0]]).expand(2, 3))
    way = 1.5 * 0.2 - 0.3 * 0.2**2 / 2
    assert state[0].tolist() == pytest.approx([0, 0, 0, 0, 0.22 + way, 0, 1.5 - 0.3 * 0.2, 0], abs=1e-5)
    assert state[1].tolist() == pytest.approx([0, 0, 0, 0, 0.32, 0, 0, 0], abs=1e-5)  # out of reach
    turned = VariedPlanar(one(), BallVariation(contact_direction_deg=(90.0, 90.0)))
    turned.reset_to(START)
    state = turned.step(torch.tensor([[0.0, 0.0, 1.0]]))
    assert state[0, 4:].tolist() == pytest.approx([0.22, way, 0, 1.5 - 0.3 * 0.2], abs=1e-5)


@pytest.mark.parametrize(
    ("variation", "entry", "expected"),
    [
        (BallVariation(ball_friction=(2.0, 2.0)), 6, 1.0 - 0.6 * 0.2),
        (BallVariation(contact_direction_deg=(90.0, 90.0)), 7, 1.0 - 0.3 * 0.2),
    ],
    ids=["friction", "direction"],
)
def test_parameters_do_what_their_names_say(variation: BallVariation, entry: int, expected: float) -> None:
    simulator = VariedPlanar(one(), variation)
    simulator.reset_to(torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0]]))
    assert simulator.step(AHEAD)[0, entry].item() == pytest.approx(expected, abs=1e-5)


def test_a_correction_moves_no_ball_that_lies_untouched() -> None:
    simulator = one(3)
    states = START.repeat(3, 1)
    states[1, 6] = 0.3  # the first is walked away from, the second rolls, the third is walked into
    simulator.reset_to(states)
    simulator.step(torch.cat([-AHEAD, -AHEAD, AHEAD]))
    landed = torch.tensor([0.1, 0.1, 0.2, 0.2, 0.5, 0.5, 0.4, 0.4]).repeat(3, 1)
    settled = simulator.settle(states, landed)
    assert torch.equal(settled[:, :4], landed[:, :4]) and torch.equal(settled[0, 4:], START[0, 4:])
    torch.testing.assert_close(settled[1:, 6:].norm(dim=-1), landed[1:, 6:].norm(dim=-1))
    assert torch.equal(simulator.state, settled)


@pytest.mark.parametrize("friction", [1.0, 2.0])
def test_a_ball_that_rolls_keeps_to_its_way_as_fast_as_corrected(friction: float) -> None:
    simulator = VariedPlanar(one(), BallVariation(ball_friction=(friction, friction)))
    rolling = torch.tensor([[0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 0.48, -0.36]])
    simulator.reset_to(rolling)
    simulator.step(STAY)
    landed = torch.tensor([[0.1, 0.1, 0.2, 0.2, 3.0, 3.0, -0.3, 0.4]])
    way = 0.5 * 0.2 + 0.3 * friction * 0.2**2 / 2  # from some speed to 0.5 m/s in 0.2 s
    expected = torch.tensor([[1.0 + 0.8 * way, 0.5 - 0.6 * way, 0.8 * 0.5, -0.6 * 0.5]])
    torch.testing.assert_close(simulator.settle(rolling, landed)[:, 4:], expected)


@pytest.mark.parametrize("before_m_s", [0.0, 0.1])
@pytest.mark.parametrize("friction", [1.0, 2.0])
def test_a_correction_says_how_likely_a_ball_that_lies_is_hit(before_m_s: float, friction: float) -> None:
    count = 20_000
    simulator = VariedPlanar(one(count), BallVariation(ball_friction=(friction, friction)))
    start = START.clone()
    start[0, 7] = before_m_s  # an estimate of a ball that lies
    simulator.reset_to(start.expand(count, 8))
    simulator.step(torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3))
    landed = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.3, 0.1, 0.06, -0.08]]).expand(count, 8)
    torch.manual_seed(0)
    way, velocity = (simulator.settle(start.expand(count, 8), landed)[:, 4:] - START[:, 4:]).split(2, dim=-1)
    speed = velocity.norm(dim=-1)
    hit = speed > 0
    # Balls that are hit are first measured at 0.2 m/s, so 0.1 m/s are half a hit.
    assert hit.float().mean().item() == pytest.approx(0.5, abs=0.01)
    slowed = 0.3 * friction  # it leaves at 0.5 m/s, and is slowed by 0.3 m/s² in the 0.2 s that it rolls
    torch.testing.assert_close(speed[hit], torch.full_like(speed[hit], 0.5 - slowed * 0.2))
    rolled = torch.full_like(speed[hit], 0.5 * 0.2 - slowed * 0.2**2 / 2)
    torch.testing.assert_close(way[hit].norm(dim=-1), rolled)
    assert not way[~hit].any()


def kicked(simulator: kicking.BallAgent, speed_m_s: float) -> torch.Tensor:
    """Kick balls that lie, and correct them to `speed_m_s`; return which roll (B,)."""
    start = START.expand(len(simulator.state), 8)
    simulator.reset_to(start)
    simulator.step(torch.tensor([[0.0, 0.0, 1.0]]).expand(len(simulator.state), 3))
    landed = start.clone()
    landed[:, 6] = speed_m_s
    return simulator.settle(start, landed)[:, 6:].any(dim=-1)


def test_kicking_on_from_too_far_does_not_help() -> None:
    """0.01 m/s say a twentieth of a hit, and a half if said for long."""
    torch.manual_seed(0)
    simulator = one(4000)
    needed = simulator.memory[:, 0].clone()
    rolled = kicked(simulator, 0.01)
    assert torch.equal(rolled, needed < 0.05)
    for _ in range(200):
        rolled |= kicked(simulator, 0.01)
    assert torch.equal(rolled, needed < 0.5 - 1e-6)


def test_a_new_lie_and_a_new_episode_are_drawn_for_anew() -> None:
    torch.manual_seed(0)
    simulator = one(1000)
    needed = simulator.memory[:, 0].clone()
    rolled = kicked(simulator, 0.1)
    after = simulator.memory
    assert torch.equal(after[~rolled, 0], needed[~rolled])
    torch.testing.assert_close(after[~rolled, 1], torch.full_like(needed[~rolled], 0.5))
    assert (after[rolled, 0] != needed[rolled]).all() and not after[rolled, 1].any()
    simulator.reset_to(START.expand(2, 8), torch.tensor([3, 5]))
    assert (simulator.memory[[3, 5], 0] != after[[3, 5], 0]).all() and not simulator.memory[[3, 5], 1].any()


TASK = kicking.Kicking(FIELD, horizon=156)
GOAL = torch.tensor([[1.5, 0.0]])


def state(robot: tuple[float, float], ball: tuple[float, float]) -> torch.Tensor:
    return torch.tensor([[*robot, 0.0, 0.0, *ball, 0.0, 0.0]])


def test_starts_are_where_the_task_says() -> None:
    starts = TASK.draw_starts(np.random.default_rng(0), 4000)
    robot, ball = starts[:, :2], starts[:, 4:6]
    assert starts.shape == (4000, 8) and (starts[:, 2:4] == 0).all() and (starts[:, 6:] == 0).all()
    assert ball.min(axis=0) == pytest.approx([-0.5, -0.6], abs=0.01)
    assert ball.max(axis=0) == pytest.approx([0.0, 0.6], abs=0.01) and (np.abs(robot) <= 1.9).all()
    apart = np.linalg.norm(robot - ball, axis=1)
    assert apart.min() >= 0.4 - 1e-9 and apart.max() <= 1.0 + 1e-9
    near = TASK.draw_anywhere(np.random.default_rng(0), 4000)
    near_m = np.linalg.norm(near[:, :2] - near[:, 4:6], axis=1)
    assert [near_m.min(), near_m.max()] == pytest.approx([0.18, 0.5], abs=0.01)
    to_goal = np.array([1.5, 0.0]) - ball  # all around the ball
    ahead = ((robot - ball) * to_goal).sum(axis=1) > 0
    assert ahead.mean() == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize(
    ("balls", "reached", "missed"),
    [  # Lines belong to the field, posts and goal line to the goal.
        ([(1.49, 0.0), (-1.99, 1.99), (-2.0, 2.0), (0.0, -2.0)], False, False),
        ([(1.5, 0.74), (1.6, -0.74), (1.5, 0.75)], True, False),
        ([(1.8, 0.76), (0.0, 2.01), (0.0, -2.01), (-2.01, 0.0), (1.6, -0.76), (1.5, 1.0)], False, True),
    ],
)
def test_a_ball_is_in_the_goal_in_the_field_or_out(
    balls: list[tuple[float, float]], reached: bool, missed: bool
) -> None:
    where = torch.cat([state((0.0, 0.0), ball) for ball in balls])
    assert (TASK.reached(where, GOAL) == reached).all() and (TASK.missed(where, GOAL) == missed).all()


def test_rewards_are_meters_gained_and_the_outcome() -> None:
    before, after = state((-1.0, 0.0), (0.0, 0.0)), state((-0.75, 0.0), (0.5, 0.0))
    none = torch.zeros(1, dtype=torch.bool)
    # The ball gains 0.5 m; the place behind it moved 0.5 m away, the robot 0.25 m on.
    assert TASK.reward(before, after, GOAL, none).item() == pytest.approx(0.5 - 0.5 * 0.25, abs=1e-5)
    assert TASK.reward(before, before, GOAL, ~none).item() == pytest.approx(-10.0)
    scored = state((1.0, 0.0), (1.5, 0.0))
    assert TASK.reward(scored, scored, GOAL, none).item() == pytest.approx(10.0)


def test_they_see_it_in_these_units() -> None:
    seen_from = torch.tensor([0.2, 0.4, 0.1, -0.1, 0.5, 0.0, 0.6, -0.2])
    seen = TASK.observe(seen_from.expand(2, 3, 8), GOAL.expand(2, 3, 2))
    # Half of positions and of the ball's way to the goal; four times the velocity; the ball's velocity; four
    # times the way to the ball, and to the point 0.2 m behind it on the line from the goal.
    expected = [0.1, 0.2, 0.25, 0.0, 0.5, 0.0, 0.4, -0.4, 0.6, -0.2, 4 * 0.3, 4 * -0.4, 4 * 0.1, 4 * -0.4]
    torch.testing.assert_close(seen, torch.tensor(expected).expand(2, 3, 14))
