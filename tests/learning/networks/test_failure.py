import math

import pytest
import torch
from torch import Tensor
from toy_episodes import toy_episodes

from astra_data.learning.networks.failure import AHEAD_S, AVERAGED_S, FailureModel, FailureShape
from astra_data.learning.networks.paired_windows import RISK_STEPS, PairedWindows
from astra_data.worlds.plane.mazes import U_MAZE

TIMESTEP_S = 0.05


def model(*, has_maze: bool = False) -> FailureModel:
    torch.manual_seed(0)
    cells = U_MAZE.fine_walls.shape
    shape = FailureShape(
        4, 2, TIMESTEP_S, (cells[0], cells[1]) if has_maze else (0, 0), U_MAZE.fine_m, members=3
    )
    made = FailureModel(shape)
    if has_maze:
        made.clearance.copy_(torch.from_numpy(U_MAZE.clearance_field))
        made.half_extent.copy_(torch.from_numpy(U_MAZE.half_extent))
    return made.requires_grad_(False).eval()


def windows(episodes: int = 3, steps: int = 12) -> PairedWindows:
    torch.manual_seed(1)
    state = torch.rand(episodes, steps + 1, 4) * 4 - 2
    landed = state[:, 1:] + torch.randn(episodes, steps, 4)
    action = 2 * torch.rand(episodes, steps, 2) - 1
    return toy_episodes(state[:, :-1], action, next_state=state[:, 1:], simulated_next=landed).windows


def rms(move: Tensor) -> float:
    return float(move.square().mean().sqrt())


def test_the_magnitudes_are_moves_in_their_deviations_and_commands() -> None:
    made, of = model(), windows()
    made.wanted_std.fill_(2.0)
    made.moved_std.fill_(3.0)
    made.missed_std.fill_(4.0)
    inputs, _ = made.histories(of)
    for episode, step in ((0, 0), (1, 5)):
        state, action = of.state[episode], of.action[episode]
        wanted = of.simulated_next[episode, step] - state[step]
        moved = state[step] - state[step - 1] if step else torch.zeros(4)
        missed = state[step] - of.simulated_next[episode, step - 1] if step else torch.zeros(4)
        before = action[step - 1] if step else torch.zeros(2)
        expected = [
            rms(wanted) / 2,
            rms(moved) / 3,
            rms(missed) / 4,
            float((action[step] - before).norm()),
            float(action[step].norm()),
        ]
        assert inputs[episode, step, :5].tolist() == pytest.approx(expected, abs=1e-5)


def test_averages_forget_with_their_time_constants() -> None:
    made, still = model(), torch.zeros(1, 40, 4)
    action = torch.tensor([3.0, 4.0]).expand(1, 40, 2)
    inputs, _ = made.histories(toy_episodes(still, action, next_state=still).windows)
    for number, seconds in enumerate(AVERAGED_S):
        of_the_action = inputs[0, :, 5 * (number + 1) + 4]
        expected = [5 * (1 - math.exp(-(step + 1) * TIMESTEP_S / seconds)) for step in range(40)]
        assert of_the_action.tolist() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("has_maze", [False, True])
def test_steps_one_by_one_are_the_whole_history(has_maze: bool) -> None:
    made, of = model(has_maze=has_maze), windows()
    inputs, before = made.histories(of)
    assert inputs.shape == (3, 12, made.shape.input_size) and before.shape == (3, 12, made.memory_size)
    memory = made.initial_memory(of.state[:, 0], of.previous_action[:, 0])
    for step in range(12):
        torch.testing.assert_close(memory, before[:, step])
        said, memory = made.step(of.state[:, step], of.action[:, step], of.simulated_next[:, step], memory)
        torch.testing.assert_close(said, made.probability(inputs[:, step]))


def test_walls_are_seen_where_the_robot_and_where_the_simulator_goes() -> None:
    made = model(has_maze=True)
    # The upper corridor of the U-Maze: walls 2 m to the north and to the south.
    state = torch.tensor([[0.0, 4.0, 0.0, 0.0]])
    landed = state + torch.tensor([[0.0, 0.05, 0.0, 0.0]])  # 1 m/s to the north
    before = state - torch.tensor([[0.0, 0.0, 0.0, 0.0]])
    memory = made.initial_memory(before, torch.zeros(1, 2))
    seen = made._signals(state, torch.zeros(1, 2), landed, *memory.split(made._parts, dim=-1)[:3])[1][0]
    to_wall = [float(U_MAZE.clearance(state[0, :2].double().numpy()))]
    for second in AHEAD_S:
        place = state[0, :2].double() + torch.tensor([0.0, second]).double()
        to_wall.append(float(U_MAZE.clearance(place.numpy())))
    assert seen[:6].tolist() == pytest.approx(to_wall, abs=0.11)
    assert to_wall[5] < 0.2 < to_wall[1] < to_wall[0]
    assert seen[6:].tolist() == pytest.approx([to_wall[0]] * 5, abs=1e-5)


def test_the_members_probabilities_are_averaged_after_the_shift() -> None:
    made, of = model(), windows()
    inputs, _ = made.histories(of)
    made.log_odds_shift.fill_(-2.0)
    odds = torch.stack([one(inputs.clamp(-5, 5)).squeeze(-1) for one in made.members])
    torch.testing.assert_close(made.probability(inputs), (odds - 2.0).sigmoid().mean(0))
    assert float((odds[0] - odds[1]).abs().max()) > 0.01
    made.calibrate(torch.tensor(0.5), torch.tensor(-3.0))
    torch.testing.assert_close(made.probability(inputs), (0.5 * odds - 3.0).sigmoid().mean(0))
    assert float(made.hazard(torch.tensor(0.5))) == pytest.approx(0.5 / RISK_STEPS)


def test_scales_are_those_of_real_steps() -> None:
    made, of = model(), windows(8, 30)
    made.set_scales(of)
    torch.testing.assert_close(made.moved_std, (of.next_state - of.state).flatten(0, 1).std(0))
    torch.testing.assert_close(made.missed_std, (of.next_state - of.simulated_next).flatten(0, 1).std(0))
    normal = (made.histories(of)[0] - made.input_mean) / made.input_std
    assert float(normal.flatten(0, 1).mean(0).abs().max()) < 1e-4
    torch.testing.assert_close(normal.flatten(0, 1).std(0), torch.ones(20), atol=1e-3, rtol=0)


def test_the_scatter_shown_is_in_what_was_moved_and_missed_and_nowhere_else() -> None:
    made, count = model(), 20_000
    state, action = torch.rand(count, 4), torch.rand(count, 2)
    _, memory = made.step(state, action, state + 0.1, made.initial_memory(state, action))
    factor = torch.tensor([[1.0, 0, 0, 0], [2.0, 1.0, 0, 0], [0, 0, 3.0, 0], [0, 0, 0, 0]])
    torch.manual_seed(5)
    shown = made.scattered(memory, factor)
    off = memory[:, :4] - shown[:, :4]
    torch.testing.assert_close(memory[:, 4:8] - shown[:, 4:8], off, atol=1e-5, rtol=0)
    assert torch.equal(memory[:, 8:], shown[:, 8:])
    torch.testing.assert_close(off.T.cov(), factor @ factor.T, atol=0.2, rtol=0.05)
