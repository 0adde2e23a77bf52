import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from grounding_models import TASK, model
from scipy.optimize import minimize
from torch import Tensor
from torch.nn.functional import elu
from toy_episodes import toy_episodes

from astra_data.grounding import failures as module
from astra_data.grounding.descent import DescentConfig
from astra_data.grounding.encoder import Members
from astra_data.grounding.failures import (
    AHEAD_S,
    AVERAGED_S,
    FailureModel,
    FailureShape,
    averages_before,
    calibration,
    failing,
    failure_skill,
    fit_failures,
    folds,
    has_failures,
    replayed_inputs,
)
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import RISK_STEPS, PairedEpisodes, PairedWindows
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.mazes import U_MAZE

HERE = torch.tensor([0.0, 4.0, 0.0, 0.0])
GROUNDING = HistoryGrounding(model())


def hurried(episodes: int, seed: int) -> PairedEpisodes:
    """Half of the robots are told to hurry from a random step on, and fail 30 steps later."""
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    action = 0.4 * torch.rand(episodes, 100, 2) - 0.2
    mask, soon = torch.ones(episodes, 100), torch.zeros(episodes, 100)
    for episode in range(0, episodes, 2):
        begun = int(rng.integers(20, 70))
        action[episode, begun:] *= 4
        mask[episode, begun + 30 :] = 0
        soon[episode, begun + 30 - RISK_STEPS : begun + 30] = 1
    state = HERE + 0.05 * torch.randn(episodes, 101, 4).cumsum(1)
    made = toy_episodes(
        *(state[:, :-1], action),
        next_state=state[:, 1:],
        simulated_next=state[:, 1:] + 0.01 * torch.randn(episodes, 100, 4),
        mask=mask,
    )
    return marked(made, soon, mask)


def marked(episodes: PairedEpisodes, soon: Tensor, mask: Tensor) -> PairedEpisodes:
    return replace(episodes, windows=replace(episodes.windows, fails_soon=soon, mask=mask))


def untrained(episodes: PairedEpisodes, latent_size: int = 0) -> FailureModel:
    torch.manual_seed(5)
    made = FailureModel(FailureShape(4, 2, TASK.timestep_s, members=1, latent_size=latent_size)).eval()
    made.set_move_scales(episodes.windows)
    return made


def left(episodes: PairedEpisodes) -> Tensor:
    """Steps to the end of each episode, its last one included, (E, T); many where there is none."""
    mask = episodes.windows.mask
    return torch.where(mask.bool(), mask.flip(1).cumsum(1).flip(1), 1000.0)


@pytest.fixture(scope="module", autouse=True)
def few_updates() -> Iterator[None]:
    """Enough for these toys, in small batches."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_DESCENT", DescentConfig(updates=60, learning_rate=1e-2))
        patch.setattr(module, "_BATCH", 256)
        yield


def test_failures_of_other_episodes_are_foreseen_as_often_as_they_come() -> None:
    training, fresh = hurried(40, 0), hurried(40, 1)
    made, figures = fit_failures(TASK, GROUNDING, training, seed=0)
    assert (made.members.count, made.shape.risk_steps, made.training) == (5, 2, False)
    assert not any(parameter.requires_grad for parameter in made.parameters())
    # A constant rate is far from knowing the moment.
    best = max(one["nats_per_failure"] for one in figures["candidates"])
    assert best > 1.0 and figures["latent"] == bool(made.shape.latent_size)
    probability = made.probability(replayed_inputs(TASK, GROUNDING, made, fresh))
    found = failure_skill(probability, failing(TASK, fresh))
    assert found["failures"] == 20 and found["auc"]["1-20"] > 0.9
    assert float(fresh.steps(made.hazard(probability)).sum()) == pytest.approx(20, rel=0.35)
    known = training.steps(replayed_inputs(TASK, GROUNDING, made, training))
    torch.testing.assert_close(made.input_mean, known.mean(0), atol=1e-5, rtol=1e-4)


def told(episodes: PairedEpisodes, *, by_latent: bool) -> Tensor:
    """Return what is seen of steps: noise, but for one entry that is larger in the last two of failures."""
    torch.manual_seed(7)
    shape = untrained(episodes).shape
    walls = 1 + 2 * 5 if TASK.plane else 0
    seen = torch.randn(*episodes.windows.mask.shape, shape.input_size + walls + 8)
    last = failing(TASK, episodes).windows.fails_soon
    seen[..., -1 if by_latent else 0] += 4.0 * last
    return seen


@pytest.mark.parametrize("by_latent", [False, True])
def test_it_sees_the_latent_where_only_the_latent_tells(by_latent: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    episodes = hurried(20, 0)
    seen = told(episodes, by_latent=by_latent)
    monkeypatch.setattr(module, "replayed_inputs", lambda _, whole, *__: seen if whole is GROUNDING else None)
    made, figures = fit_failures(TASK, GROUNDING, episodes, seed=0)
    assert figures["latent"] is by_latent and made.shape.latent_size == (8 if by_latent else 0)
    without, with_latent = (one["nats_per_failure"] for one in figures["candidates"])
    assert [one["latent"] for one in figures["candidates"]] == [False, True]
    assert (with_latent > without) is by_latent and max(with_latent, without) > 1.0
    said = made.probability(seen[..., : made.shape.input_size])
    fails = failing(TASK, episodes).windows.fails_soon.bool()
    assert said[fails].mean() > 5 * episodes.steps(said).mean()


def test_the_seed_decides_folds_and_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    episodes, divided = hurried(20, 0), list[Tensor]()
    known, alike = failing(TASK, episodes), torch.zeros(20, 100, 20)
    fitted = module._descended(untrained(episodes).train(), known, alike).requires_grad_(False)
    share = float(known.steps(known.windows.fails_soon).mean())  # though a quarter of each batch fails
    assert float(fitted.probability(alike[0, :1])) == pytest.approx(share, rel=0.2) and not fitted.training
    monkeypatch.setattr(module, "_cross_fitted", lambda *given: divided.append(torch.stack(given[-1])))
    monkeypatch.setattr(module, "_descended", lambda network, *_: network)
    first, again, other = (fit_failures(TASK, GROUNDING, episodes, seed)[0].members.first for seed in (0, 0, 1))
    assert torch.equal(first.weight, again.weight) and not torch.equal(first.weight, other.weight)
    assert torch.equal(divided[0], divided[2]) and not torch.equal(divided[0], divided[4])


def test_the_likelihood_is_that_of_the_moments_over_a_constant_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """In numpy, from the log-odds that two members give in cross-fitting; the scale is scipy's."""
    episodes = hurried(12, 0)
    fails, recordings = torch.arange(12) % 2 == 0, torch.arange(12)
    torch.manual_seed(3)
    seen = told(episodes, by_latent=False)
    seen[..., 1] = seen[..., 0] + torch.randn(12, 100)
    fitted: list[Tensor] = []

    class Known:
        log_odds_shift = torch.zeros(())

        def log_odds(self, inputs: Tensor) -> Tensor:
            return inputs[..., :2].movedim(-1, 0) - 2.0

    def descended(_: FailureModel, others: PairedEpisodes, inputs: Tensor) -> Known:
        fitted.append(others.steps(inputs))
        return Known()

    monkeypatch.setattr(module, "_descended", descended)
    divided = folds(fails, recordings)
    found = module._cross_fitted(untrained(episodes), failing(TASK, episodes), seen, divided)
    real = episodes.windows.mask.numpy().astype(bool)
    steps_left = left(episodes).numpy()[real]
    is_failing = np.repeat(fails.numpy()[:, None], 100, 1)[real]
    odds = seen[..., :2].double().numpy()[real].T - 2.0
    soon, now = is_failing & (steps_left <= 2), is_failing & (steps_left == 1)
    assert now.sum() == 6 and soon.sum() == 12

    def surprise(of: Any) -> float:
        said = np.exp(of[0]) * odds + of[1]
        return float(np.mean(np.logaddexp(0, said) - soon * said) + 0.5 * of[0] ** 2 * 2 / odds.shape[1])

    scale, shift = minimize(surprise, [0.0, 0.0], tol=1e-9).x
    hazard = (1 / (1 + np.exp(-np.exp(scale) * odds - shift))).mean(0) / 2
    rate = now.mean()
    expected = np.log(np.where(now, hazard, 1 - hazard)).sum() - np.log(np.where(now, rate, 1 - rate)).sum()
    assert found is not None and found[0] == pytest.approx(expected / 6, abs=1e-3) and found[0] > 0.1
    assert [float(one) for one in found[1:]] == pytest.approx([np.exp(scale), shift], abs=1e-2)
    counts = [int(episodes.windows.mask[~fold].sum()) for fold in divided]  # whoever predicts a fold has not seen it
    assert [len(one) for one in fitted] == counts and len(counts) == 5


def test_failures_that_abstract_states_show_are_left_to_the_simulator() -> None:
    """A ball beside the goal is one, wherever the padding of its episode goes; a fall is none."""
    kick = TASKS["nao-kick"]
    goal = torch.from_numpy(kick.objective.draw_goals(np.random.default_rng(0), 1)).float()
    state = torch.zeros(3, 30, 8)
    after = state.clone()
    after[0, 19, 4:6] = after[2, 25:, 4:6] = goal + torch.tensor([0.1, 1.5])
    mask = torch.ones(3, 30)
    mask[0, 20:] = mask[2, 20:] = 0
    made = toy_episodes(
        state, torch.zeros(3, 30, 2), next_state=after, mask=mask, goal=goal.expand(3, 30, 2).contiguous()
    )
    made = marked(made, mask, mask)
    unseen = failing(kick, made, 20)
    expected = torch.zeros(3, 30)
    expected[1, 10:] = expected[2, :20] = 1
    assert torch.equal(unseen.windows.fails_soon, expected) and torch.equal(unseen.windows.state, state)
    # Nor does the third alone do: there is no step but before its failure.
    assert [has_failures(kick, made.select(torch.tensor(of))) for of in ([0, 1, 2], [0], [2])] == [True, False, False]


def test_what_is_seen_of_a_step_is_simulated_from_two_to_three_seconds_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step by itself: from the moment 40 to 59 steps before it, with the history until then."""
    episodes = hurried(3, 0)
    windows, failures = episodes.windows, untrained(episodes, latent_size=8)
    seen = replayed_inputs(TASK, GROUNDING, failures, episodes)
    drawn, seeds = torch.random.get_rng_state(), list[int]()
    monkeypatch.setattr(torch.cuda, "manual_seed_all", seeds.append)
    averages = averages_before(TASK, GROUNDING, failures, episodes)
    assert torch.equal(torch.random.get_rng_state(), drawn) and not seeds
    assert seen.shape == (3, 100, 28) and averages.shape == (3, 100, 15) and not averages[:, 0].any()
    for episode, step, begun in ((1, 0, 0), (1, 59, 0), (0, 60, 20), (1, 79, 20), (1, 80, 40), (1, 99, 40)):
        world = GROUNDING.corrected(TASK.simulator(1))
        state, before = windows.state[episode, begun][None], windows.previous_action[episode, begun][None]
        hidden = GROUNDING.hidden_before(windows)[episode, begun][None]
        goal = windows.goal[episode, begun][None]
        world.start(state, torch.tensor([0]), goal, hidden=hidden, previous_action=before)
        memory = failures.initial_memory(state, before)
        for action in windows.action[episode, begun : step + 1]:
            here, latent = world.state, world.latent
            world.step(action[None])
            inputs, memory = failures.inputs(here, action[None], world.landed, latent, memory)
        torch.testing.assert_close(seen[episode, step], inputs[0], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(seen[episode, step, 20:], latent[0], atol=1e-4, rtol=1e-4)
        if step not in (59, 79, 99):  # the next step is seen from another moment, or there is none
            torch.testing.assert_close(averages[episode, step + 1], memory[0, -15:], atol=1e-4, rtol=1e-4)


def test_the_windows_before_a_failure_are_ranked_against_calm_steps() -> None:
    """One episode fails after 60 steps: what is said is right 11 to 30 steps ahead alone."""
    mask, soon = torch.ones(2, 100), torch.zeros(2, 100)
    mask[0, 60:], soon[0, 40:60] = 0, 1
    episodes = marked(hurried(2, 0), soon, mask)
    ahead = left(episodes)
    said = torch.where((ahead >= 11) & (ahead <= 30) & (torch.arange(2) == 0)[:, None], 0.9, 0.1)
    found = failure_skill(said, episodes)
    # Ten of the twenty steps of the neighboring windows are above all calm ones, ten level with them.
    assert found["auc"] == {"1-20": pytest.approx(0.75), "11-30": 1.0, "21-40": pytest.approx(0.75)}
    # Within 20 steps fail 10 of the 20 at 0.9, and 10 of the 140 at 0.1.
    assert found["reliability"] == [pytest.approx([0.1, 10 / 140, 140]), pytest.approx([0.9, 10 / 20, 20])]
    wrong, usual = (20 * 0.9**2 + 140 * 0.1**2) / 160, 20 / 160 * 140 / 160
    assert found["brier_skill"] == pytest.approx(1 - wrong / usual, rel=1e-3)


TIMESTEP_S = 0.05


def failure_model(*, has_maze: bool = False, latent_size: int = 0) -> FailureModel:
    torch.manual_seed(0)
    cells = U_MAZE.fine_walls.shape
    sizes = (cells[0], cells[1]) if has_maze else (0, 0)
    made = FailureModel(FailureShape(4, 2, TIMESTEP_S, sizes, U_MAZE.fine_m, members=3, latent_size=latent_size))
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


def seen(made: FailureModel, of: PairedWindows) -> Tensor:
    """Return the inputs (E, T, I) of all steps, one by one."""
    memory, inputs = made.initial_memory(of.state[:, 0], of.previous_action[:, 0]), []
    nothing = torch.zeros(len(of.state), 0)
    for step in range(of.state.shape[1]):
        now = of.state[:, step], of.action[:, step], of.simulated_next[:, step], nothing
        one, memory = made.inputs(*now, memory)
        inputs.append(one)
    return torch.stack(inputs, dim=1)


def rms(move: Tensor) -> float:
    return float(move.square().mean().sqrt())


def test_the_magnitudes_are_moves_in_their_deviations_and_commands() -> None:
    made, of = failure_model(), windows()
    of.previous_action[:, 0], of.mask[2, 6:] = 0.5, 0.0
    for moving in (of.state, of.next_state, of.simulated_next):
        moving[..., 3] = 1.0  # but for the last entry
    ways = of.simulated_next - of.state, of.next_state - of.state, of.next_state - of.simulated_next
    wanted_std, moved_std, missed_std = (way[of.mask.bool()].std(0).clamp_min(1e-3) for way in ways)
    made.set_move_scales(of)
    inputs = seen(made, of)
    for episode, step in ((0, 0), (1, 5)):
        state, action = of.state[episode], of.action[episode]
        wanted = of.simulated_next[episode, step] - state[step]
        moved = state[step] - state[step - 1] if step else torch.zeros(4)
        missed = state[step] - of.simulated_next[episode, step - 1] if step else torch.zeros(4)
        expected = [rms(wanted / wanted_std), rms(moved / moved_std), rms(missed / missed_std)]
        expected += [float((action[step] - of.previous_action[episode, step]).norm()), float(action[step].norm())]
        assert inputs[episode, step, :5].tolist() == pytest.approx(expected, abs=1e-5)


def test_members_are_networks_of_two_hidden_layers_each() -> None:
    members = Members(3, 4, 5, dropout=0.2).eval()
    inputs, first = torch.randn(2, 7, 4), members.first
    for number, found in enumerate(members(inputs)):
        rows = slice(5 * number, 5 * number + 5)
        hidden = elu(inputs @ first.weight[rows].T + first.bias[rows])
        hidden = elu(hidden @ members.second_weight[number] + members.second_bias[number])
        expected = (hidden @ members.last_weight[number] + members.last_bias[number]).squeeze(-1)
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-5)
    wide = Members(1, 4, 64, dropout=0.0)
    assert float(wide.second_weight.detach().abs().max()) == pytest.approx(64**-0.5, rel=0.05)
    members.train()
    assert not torch.equal(members(inputs), members(inputs))  # entries are dropped at random
    with torch.no_grad():
        first.weight.zero_()
    first.bias.data.zero_()
    assert not torch.equal(members(inputs), members(inputs))  # of both hidden layers


def test_averages_forget_with_their_time_constants() -> None:
    made, still = failure_model(), torch.zeros(1, 40, 4)
    action = torch.tensor([3.0, 4.0]).expand(1, 40, 2)
    inputs = seen(made, toy_episodes(still, action, next_state=still).windows)
    for number, seconds in enumerate(AVERAGED_S):
        of_the_action = inputs[0, :, 5 * (number + 1) + 4]
        expected = [5 * (1 - math.exp(-(step + 1) * TIMESTEP_S / seconds)) for step in range(40)]
        assert of_the_action.tolist() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("latent_size", [0, 8])
@pytest.mark.parametrize("has_maze", [False, True])
def test_the_latent_is_the_last_that_is_seen(has_maze: bool, latent_size: int) -> None:
    made, of = failure_model(has_maze=has_maze, latent_size=latent_size), windows()
    memory, latent = made.initial_memory(of.state[:, 0], of.previous_action[:, 0]), torch.randn(3, 8)
    inputs, after = made.inputs(of.state[:, 0], of.action[:, 0], of.simulated_next[:, 0], latent, memory)
    seen = (31 if has_maze else 20) + latent_size
    assert inputs.shape == (3, seen) and made.shape.input_size == seen and after.shape == (3, made.memory_size)
    assert torch.equal(inputs[:, seen - latent_size :], latent[:, :latent_size])


def test_walls_are_seen_where_the_robot_and_where_the_simulator_goes() -> None:
    made = failure_model(has_maze=True)
    # The lower corridor of the U-Maze: walls 2 m to the north and to the south.
    state = torch.tensor([[0.0, -4.0, 0.0, 0.0]])
    landed = state + torch.tensor([[0.0, 0.05, 0.0, 0.0]])  # 1 m/s to the north
    step = state, torch.zeros(1, 2), landed, torch.zeros(1, 0), made.initial_memory(state, torch.zeros(1, 2))
    walls = made.inputs(*step)[0][0, 20:]
    to_wall = [float(U_MAZE.clearance(state[0, :2].double().numpy()))]
    for second in AHEAD_S:
        place = state[0, :2].double() + torch.tensor([0.0, second]).double()
        to_wall.append(float(U_MAZE.clearance(place.numpy())))
    assert walls[:6].tolist() == pytest.approx(to_wall, abs=0.11) and to_wall[5] < 0.2 < to_wall[1] < to_wall[0]
    assert walls[6:].tolist() == pytest.approx([to_wall[0]] * 5, abs=1e-5)
    made.clearance = torch.nn.Buffer(torch.arange(3.0).repeat(2, 1))  # wider than high: beyond, its outermost cells
    assert made.inputs(*step)[0][0, 20:].tolist() == [2.0] * 11
    made.clearance.fill_(5.0)
    assert made.inputs(*step)[0][0, 20:].tolist() == [3.0] * 11  # beyond, walls are alike


def test_walls_are_those_of_the_recorded_steps() -> None:
    """And not of replays, which have drifted."""
    episodes = hurried(3, 0)
    windows, failures = episodes.windows, failure_model(has_maze=True, latent_size=8)
    seen = replayed_inputs(TASK, GROUNDING, failures, episodes)
    for episode, step in ((0, 0), (1, 60), (2, 99)):
        here, landed, action = (
            of[episode, step][None] for of in (windows.state, windows.simulated_next, windows.action)
        )
        memory = failures.initial_memory(windows.state[episode, max(step - 1, 0)][None], action)
        inputs, _ = failures.inputs(here, action, landed, torch.zeros(1, 8), memory)
        torch.testing.assert_close(seen[episode, step, 20:31], inputs[0, 20:31])
        if step:
            assert not torch.allclose(seen[episode, step, :20], inputs[0, :20], rtol=0.01)


def test_log_odds_are_scaled_and_shifted_to_what_happens() -> None:
    """Two members say twice and four times too much of events whose log-odds they know."""
    torch.manual_seed(0)
    true = 1.5 * torch.randn(40_000) - 2.0
    happens = (torch.rand(len(true)) < true.sigmoid()).float()
    for factor in (2.0, 0.5):
        scale, shift = calibration((factor * (true + 1.0)).expand(2, -1), happens, 1)
        assert float(scale) == pytest.approx(1 / factor, rel=0.05) and float(shift) == pytest.approx(-1.0, abs=0.05)
    made = failure_model()
    made.members.last_weight.zero_()
    made.members.last_bias.copy_(torch.tensor([-2.0, 0.0, 4.0])[:, None, None])
    made.log_odds_shift.fill_(0.5)
    said = torch.tensor([-1.5, 0.5, 4.5]).sigmoid().mean()
    torch.testing.assert_close(made.probability(torch.zeros(1, made.shape.input_size)), said[None])


@pytest.mark.parametrize(("failing", "count"), [(1, 0), (2, 2), (4, 4), (13, 5)])
def test_folds_share_failing_and_other_episodes_alike(failing: int, count: int) -> None:
    torch.manual_seed(0)
    fails = torch.arange(40) >= 40 - failing
    each = torch.arange(40)
    found = folds(fails, each)
    assert len(found) == count
    if found:
        assert torch.equal(torch.stack(found).sum(0), torch.ones(40, dtype=torch.long))
        for rows in (fails, ~fails):
            sizes = [int((fold & rows).sum()) for fold in found]
            assert max(sizes) - min(sizes) <= 1
        assert found[0].nonzero().squeeze(1).tolist() != [*range(0, 40, count)]  # at random
    assert not torch.equal(torch.stack(folds(fails, each) or [fails]), torch.stack(found or [~fails]))


def test_copies_are_in_the_fold_of_their_recording() -> None:
    torch.manual_seed(0)
    recordings = torch.tensor([9, 9, 9, 4, 4, 4, 7, 7, 7, 2, 2, 2])
    fails = recordings >= 7
    found = folds(fails, recordings)
    assert len(found) == 2  # recordings that fail, though six episodes do
    for fold in found:
        for recording in recordings.unique():
            assert len(fold[recordings == recording].unique()) == 1
        assert int((fold & fails).sum()) == int((fold & ~fails).sum()) == 3
    assert folds(recordings == 9, recordings) == []
    torch.manual_seed(1)
    alone, shuffled = folds(fails, torch.arange(12)), torch.tensor([7, 3, 11, 0, 5, 9, 1, 10, 2, 8, 6, 4])
    torch.manual_seed(1)
    assert torch.equal(torch.stack(alone), torch.stack(folds(fails, shuffled)))
