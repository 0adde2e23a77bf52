from typing import Any

import pytest
import torch

from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.robots.nao.kicking import BallAgent
from astra_data.worlds.plane.mazes import FIELD
from astra_data.worlds.plane.point_mass import VariedPlanar
from astra_data.worlds.variation import BallVariation

OPTIONS: dict[str, Any] = {
    "timestep_s": 0.2,
    "radius_m": 0.2,
    "speed_m_s": 0.25,
    "reach_m": 0.19,
    "knock_m_s": 1.0,
    "kick_reach_m": 0.3,
    "kick_m_s": 1.5,
}
AHEAD = torch.tensor([[1.0, 0.0, 0.0]])
STAY = torch.zeros(1, 3)
START = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.22, 0.0, 0.0, 0.0]])


def one(count: int = 1) -> BallAgent:
    simulator = BallAgent(FIELD, count, **OPTIONS)
    simulator.reset_to(START.expand(count, 8))
    return simulator


def test_it_walks_into_its_ball() -> None:
    simulator = one()
    state = simulator.step(AHEAD)
    # The ball leaves at 1 m/s from 0.19 m ahead of 0.05 m, and rolls for 0.2 s.
    way = 1.0 * 0.2 - 0.3 * 0.2**2 / 2
    expected = [0.05, 0.0, 0.25, 0.0, 0.05 + 0.19 + way, 0.0, 1.0 - 0.3 * 0.2, 0.0]
    assert state[0].tolist() == pytest.approx(expected, abs=1e-5)
    for _ in range(100):
        state = simulator.step(STAY)
    assert state[0, 4].item() == pytest.approx(0.24 + 1.0 / 0.6, abs=1e-4)
    assert state[0, 6:].abs().max() == 0


def test_it_walks_from_wherever_it_is() -> None:
    simulator = one()
    here = torch.tensor([[0.6, -0.4, 0.0, 0.0, 2.0, 2.0, 0.0, 0.0]])
    simulator.reset_to(here)
    state = simulator.step(torch.tensor([[-0.4, 0.8, 0.0]]))
    assert state[0].tolist() == pytest.approx([0.58, -0.36, -0.1, 0.2, 2.0, 2.0, 0.0, 0.0], abs=1e-5)


def test_it_stands_and_kicks() -> None:
    simulator = one(2)
    simulator.reset_to(torch.cat([START, START + torch.tensor([0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0])]))
    state = simulator.step(torch.tensor([[1.0, 0.0, 1.0]]).expand(2, 3))
    way = 1.5 * 0.2 - 0.3 * 0.2**2 / 2
    assert state[0].tolist() == pytest.approx([0, 0, 0, 0, 0.22 + way, 0, 1.5 - 0.3 * 0.2, 0], abs=1e-5)
    # Out of reach.
    assert state[1].tolist() == pytest.approx([0, 0, 0, 0, 0.32, 0, 0, 0], abs=1e-5)


def test_walls_stop_the_mass_but_not_the_ball() -> None:
    simulator = one()
    for _ in range(200):
        state = simulator.step(AHEAD)
    assert simulator.blocked.all()
    # The room's inside ends at 2.5 m, 0.2 m before which the mass is stopped.
    assert state[0, 0].item() == pytest.approx(2.3, abs=0.01)
    assert state[0, 4].item() > 2.5
    simulator.reset_to(START, torch.tensor([0]))
    assert not simulator.blocked.any()


def test_a_correction_is_taken_over_as_far_as_there_is_room() -> None:
    simulator = one()
    simulator.step(AHEAD)
    landed = torch.tensor([[0.3, 0.1, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])
    settled = simulator.settle(START, landed)
    assert torch.equal(settled[:, :4], landed[:, :4])
    assert torch.equal(simulator.state, settled)
    far = landed.clone()
    far[0, 1] = 9.0
    settled = simulator.settle(START, far)
    assert settled[0, 1].item() < 2.31
    assert torch.equal(settled[:, 2:4], far[:, 2:4])


def test_plain_parameters_are_the_plain_simulator() -> None:
    torch.manual_seed(0)
    varied, plain = VariedPlanar(one(50), BallVariation()), one(50)
    for step in range(60):
        before, action = plain.state, torch.randn(50, 3)
        torch.testing.assert_close(varied.step(action), plain.step(action))
        if step % 5 == 0:
            landed = plain.state + 0.05 * torch.randn(50, 8)
            both = []
            for simulator in (varied, plain):
                torch.manual_seed(step)  # what corrections cannot tell is drawn
                both.append(simulator.settle(before, landed))
            torch.testing.assert_close(*both)
        assert torch.equal(varied.blocked, plain.blocked)


@pytest.mark.parametrize(
    ("variation", "entry", "expected"),
    [
        (BallVariation(ball_friction=(2.0, 2.0)), 6, 1.0 - 0.6 * 0.2),
        (BallVariation(contact_direction_deg=(90.0, 90.0)), 7, 1.0 - 0.3 * 0.2),
        (BallVariation(friction=(0.5, 0.5)), 2, 0.125),
    ],
    ids=["friction", "direction", "speed"],
)
def test_parameters_do_what_their_names_say(variation: BallVariation, entry: int, expected: float) -> None:
    simulator = VariedPlanar(one(), variation)
    simulator.reset_to(torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0]]))
    state = simulator.step(AHEAD)
    assert state[0, entry].item() == pytest.approx(expected, abs=1e-5)


def test_the_direction_of_a_kick_varies_too() -> None:
    simulator = VariedPlanar(one(), BallVariation(contact_direction_deg=(90.0, 90.0)))
    simulator.reset_to(START)
    state = simulator.step(torch.tensor([[1.0, 0.0, 1.0]]))
    assert state[0, 6:].tolist() == pytest.approx([0.0, 1.5 - 0.3 * 0.2], abs=1e-5)


def test_noise_of_sensors_only_shows() -> None:
    torch.manual_seed(0)
    variation = BallVariation(ball_position_noise_m=(0.1, 0.1), ball_velocity_noise_m_s=(0.2, 0.2))
    simulator = VariedPlanar(one(5000), variation)
    simulator.reset_to(START.expand(5000, 8))
    simulator.step(torch.zeros(5000, 3))
    error = (simulator.state - simulator.true_state).abs().amax(0)
    torch.testing.assert_close(
        error, torch.tensor([0.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.2, 0.2]), atol=1e-4, rtol=0.01
    )


def test_a_correction_moves_no_ball_that_lies_untouched() -> None:
    simulator = one(3)
    states = START.repeat(3, 1)
    # The first is walked away from, the second rolls, the third is walked into.
    states[1, 6] = 0.3
    simulator.reset_to(states)
    simulator.step(torch.cat([-AHEAD, -AHEAD, AHEAD]))
    landed = torch.tensor([0.1, 0.1, 0.2, 0.2, 0.5, 0.5, 0.4, 0.4]).repeat(3, 1)
    settled = simulator.settle(states, landed)
    assert torch.equal(settled[:, :4], landed[:, :4])
    assert torch.equal(settled[0, 4:], START[0, 4:])
    torch.testing.assert_close(settled[1:, 6:].norm(dim=-1), landed[1:, 6:].norm(dim=-1))
    assert torch.equal(simulator.state, settled)


@pytest.mark.parametrize("friction", [1.0, 2.0])
def test_a_ball_that_rolls_keeps_to_its_way_as_fast_as_corrected(friction: float) -> None:
    simulator = VariedPlanar(one(), BallVariation(ball_friction=(friction, friction)))
    rolling = torch.tensor([[0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 0.48, -0.36]])
    simulator.reset_to(rolling)
    simulator.step(STAY)
    landed = torch.tensor([[0.1, 0.1, 0.2, 0.2, 3.0, 3.0, -0.3, 0.4]])
    # From some speed to 0.5 m/s in 0.2 s.
    way = 0.5 * 0.2 + 0.3 * friction * 0.2**2 / 2
    expected = torch.tensor([[1.0 + 0.8 * way, 0.5 - 0.6 * way, 0.8 * 0.5, -0.6 * 0.5]])
    torch.testing.assert_close(simulator.settle(rolling, landed)[:, 4:], expected)


def test_a_correction_that_all_but_stops_a_ball_leaves_it_where_it_was() -> None:
    simulator = one(2)
    rolling = START.repeat(2, 1)
    rolling[:, 6] = 0.3
    simulator.reset_to(rolling)
    simulator.step(STAY.repeat(2, 1))
    landed = torch.tensor([0.1, 0.1, 0.2, 0.2, 0.24, 0.0, 0.14, 0.0]).repeat(2, 1)
    landed[1, 6] = 0.16
    settled = simulator.settle(rolling, landed)
    assert torch.equal(settled[:, :4], landed[:, :4])
    assert torch.equal(settled[0, 4:], START[0, 4:])
    assert settled[1, 6].item() == pytest.approx(0.16)


def test_a_ball_that_a_correction_stops_can_roll_again() -> None:
    simulator = one()
    rolling = START.clone()
    rolling[:, 6] = 0.3
    simulator.reset_to(rolling)
    simulator.step(STAY)
    landed = torch.tensor([[0.1, 0.1, 0.2, 0.2, 0.5, 0.0, 0.0, 0.0]])
    simulator.settle(rolling, landed)
    assert simulator.memory.isfinite().all()


@pytest.mark.parametrize("before_m_s", [0.0, 0.1])
@pytest.mark.parametrize("friction", [1.0, 2.0])
def test_whether_a_correction_sets_a_ball_rolling_is_drawn_with_the_expected_speed(
    before_m_s: float, friction: float
) -> None:
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
    assert speed.mean().item() == pytest.approx(0.1, abs=0.003)
    hit = speed > 0
    # It leaves at 0.5 m/s, and is slowed by 0.3 m/s² in the 0.2 s that it rolls.
    slowed = 0.3 * friction
    torch.testing.assert_close(speed[hit], torch.full_like(speed[hit], 0.5 - slowed * 0.2))
    rolled = torch.full_like(speed[hit], 0.5 * 0.2 - slowed * 0.2**2 / 2)
    torch.testing.assert_close(way[hit].norm(dim=-1), rolled)
    assert not way[~hit].any()


def test_a_ball_that_is_hit_leaves_about_the_way_that_the_simulator_has_it_go() -> None:
    torch.manual_seed(0)
    count = 20_000
    start = START.expand(count, 8).clone()
    start[:, 4:6] = torch.tensor([0.0, 0.25])
    simulator = one(count)
    simulator.reset_to(start)
    simulator.step(torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3))
    landed = start.clone()
    landed[:, 6] = 0.8  # the correction expects it to go to the right, the simulator ahead
    x, y, vx, vy = (simulator.settle(start, landed) - start)[:, 4:].T
    turn_rad = torch.atan2(-vx, vy)
    assert turn_rad.mean().item() == pytest.approx(0.0, abs=0.01)
    assert turn_rad.std().item() == pytest.approx(0.4, abs=0.01)
    torch.testing.assert_close(torch.atan2(-x, y), turn_rad)


def test_the_way_of_a_ball_that_nothing_moves_says_nothing() -> None:
    """The simulator has no direction for it; one that is not a number would stay in the memory."""
    simulator = one()
    for _ in range(3):
        simulator.step(STAY)
        simulator.settle(simulator.state, simulator.state)
    assert simulator.memory.isfinite().all()


def test_a_correction_as_slow_as_scatter_sets_no_ball_rolling() -> None:
    simulator, count = one(2000), 2000
    simulator.step(torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3))
    landed = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.3, 0.1, 0.04, 0.02]]).expand(count, 8)
    assert torch.equal(simulator.settle(START.expand(count, 8), landed)[:, 4:], START[:, 4:].expand(count, 4))


def test_a_correction_may_be_faster_than_what_balls_leave_with_at_least() -> None:
    simulator = one(100)
    assert kicked(simulator, 0.6).all()
    torch.testing.assert_close(simulator.state[:, 6:].norm(dim=-1), torch.full((100,), 0.6))


def kicked(simulator: BallAgent, speed_m_s: float) -> torch.Tensor:
    """Kick balls that lie, and correct them to `speed_m_s`; return which roll (B,)."""
    start = START.expand(simulator.num_envs, 8)
    simulator.reset_to(start)
    simulator.step(torch.tensor([[0.0, 0.0, 1.0]]).expand(simulator.num_envs, 3))
    landed = start.clone()
    landed[:, 6] = speed_m_s
    return simulator.settle(start, landed)[:, 6:].any(dim=-1)


def test_kicking_on_from_too_far_does_not_help() -> None:
    """A ball that is hit ends at 0.44 m/s: 0.055 says an eighth of a hit, and a half if said for long."""
    torch.manual_seed(0)
    simulator = one(4000)
    needed = simulator.memory[:, 0].clone()
    rolled = kicked(simulator, 0.055)
    assert torch.equal(rolled, needed < 0.125)
    for _ in range(60):
        rolled |= kicked(simulator, 0.055)
    assert torch.equal(rolled, needed < 0.5 - 1e-6)


def test_a_new_lie_and_a_new_episode_are_drawn_for_anew() -> None:
    torch.manual_seed(0)
    simulator = one(1000)
    needed = simulator.memory[:, 0].clone()
    rolled = kicked(simulator, 0.22)
    after = simulator.memory
    assert torch.equal(after[~rolled, 0], needed[~rolled])
    torch.testing.assert_close(after[~rolled, 1], torch.full_like(needed[~rolled], 0.5))
    assert (after[rolled, 0] != needed[rolled]).all() and not after[rolled, 1].any()
    simulator.reset_to(START.expand(2, 8), torch.tensor([3, 5]))
    assert (simulator.memory[[3, 5], 0] != after[[3, 5], 0]).all() and not simulator.memory[[3, 5], 1].any()


def test_a_training_that_goes_on_remembers_it() -> None:
    agent, other = one(5), one(5)
    kicked(agent, 0.22)
    EpisodeSimulator(other).load_state_dict(EpisodeSimulator(agent).state_dict())
    assert torch.equal(other.memory, agent.memory)
