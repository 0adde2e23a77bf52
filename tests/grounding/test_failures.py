from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from toy_episodes import toy_episodes

from astra_data.grounding import failures as module
from astra_data.grounding.failures import (
    averages_before,
    compared_foresight,
    failing,
    fit_failures,
    foresight,
    replayed_inputs,
    tells_failures,
)
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.descent import DescentConfig
from astra_data.learning.networks.failure import FailureModel, FailureShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.learning.networks.paired_windows import RISK_STEPS
from astra_data.worlds.registry import TASKS

TASK = TASKS["antmaze-umaze"]
HERE = torch.tensor([0.0, 4.0, 0.0, 0.0])
ROW = torch.tensor([0])


def grounding_model() -> GroundingModel:
    """A model that corrects at random, by its latents."""
    torch.manual_seed(0)
    made = GroundingModel(GroundingShape(4, 2, 2, latent_size=8)).requires_grad_(False).eval()
    list(made.corrections.parameters())[-2].normal_(std=0.02)
    return made


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
    return replace(made, windows=replace(made.windows, fails_soon=soon))


def said_of(model: FailureModel, episodes: PairedEpisodes) -> Tensor:
    return model.probability(replayed_inputs(TASK, HistoryGrounding(grounding_model()), model, episodes))


@pytest.fixture(scope="module", autouse=True)
def few_updates() -> Iterator[None]:
    """Enough for these toys."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("astra_data.grounding.failures._DESCENT", DescentConfig(updates=60, learning_rate=1e-2))
        yield


@pytest.fixture(scope="module")
def foreseeing(few_updates: None) -> FailureModel:
    return fit_failures(TASK, HistoryGrounding(grounding_model()), hurried(40, 0), 2, seed=0)


def test_failures_of_other_episodes_are_foreseen_at_their_rate(foreseeing: FailureModel) -> None:
    fresh = hurried(40, 1)
    assert len(foreseeing.members) == 2
    found = foresight(said_of(foreseeing, fresh), fresh)
    assert found["failures"] == 20
    assert found["auc"]["1-20"] > 0.95
    assert found["brier_skill"] > 0.5
    said = fresh.steps(said_of(foreseeing, fresh))
    rate = fresh.steps(fresh.windows.fails_soon)
    assert float(said.mean()) == pytest.approx(float(rate.mean()), rel=0.3)


def test_the_seed_decides_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("astra_data.grounding.failures._DESCENT", DescentConfig(updates=4))
    one, same, other = (
        fit_failures(TASK, HistoryGrounding(grounding_model()), hurried(6, 0), 1, seed).state_dict()
        for seed in (0, 0, 1)
    )
    assert all(torch.equal(values, same[name]) for name, values in one.items())
    assert any(not torch.equal(values, other[name]) for name, values in one.items())


@pytest.mark.parametrize("soon", [0.0, 1.0])
def test_nothing_is_told_where_nothing_fails_or_everything(soon: float) -> None:
    episodes = hurried(4, 0)
    assert tells_failures(TASK, episodes)
    alike = replace(episodes, windows=replace(episodes.windows, fails_soon=torch.full((4, 100), soon)))
    assert not tells_failures(TASK, alike, 100)


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
    made = replace(made, windows=replace(made.windows, fails_soon=mask))
    unseen = failing(kick, made, 20)
    expected = torch.zeros(3, 30)
    expected[1, 10:] = expected[2, :20] = 1
    assert torch.equal(unseen.windows.fails_soon, expected)
    assert torch.equal(unseen.windows.state, state)
    assert tells_failures(kick, made) and not tells_failures(kick, made.select(torch.tensor([0])))


def test_the_last_steps_before_a_failure_are_as_many_as_asked_for() -> None:
    episodes = hurried(4, 0)
    for steps in (1, 3, RISK_STEPS, 50):
        marked = failing(TASK, episodes, steps).windows.fails_soon
        assert torch.equal(
            marked.bool(), episodes.windows.fails_soon.any(1, True) & (left(episodes) <= steps)
        )
    assert torch.equal(failing(TASK, episodes, RISK_STEPS).windows.fails_soon, episodes.windows.fails_soon)


def left(episodes: PairedEpisodes) -> Tensor:
    """Steps to the end of each episode, its last one included, (E, T); many where there is none."""
    mask = episodes.windows.mask
    return torch.where(mask.bool(), mask.flip(1).cumsum(1).flip(1), 1000.0)


def test_a_model_of_fewer_steps_knows_the_moment_and_expects_as_many_failures(
    foreseeing: FailureModel,
) -> None:
    """Robots that hurry fail after 30 steps of it: within 3 steps is told later than within 20."""
    training, fresh = hurried(40, 0), hurried(40, 1)
    few = fit_failures(TASK, HistoryGrounding(grounding_model()), training, 2, 0, 3)
    hazards = {}
    for steps, model in ((3, few), (RISK_STEPS, foreseeing)):
        assert model.shape.risk_steps == steps
        hazards[steps] = model.hazard(said_of(model, fresh)) * fresh.windows.mask
        assert float(hazards[steps].sum()) == pytest.approx(20, rel=0.35)
    last = fresh.windows.fails_soon.any(1, True) & (left(fresh) <= 3)
    late = {steps: float(hazard[last].sum() / hazard.sum()) for steps, hazard in hazards.items()}
    assert late[3] > 1.5 * late[RISK_STEPS]


def test_what_is_seen_of_a_step_is_simulated_from_two_to_three_seconds_before() -> None:
    """Each step by itself: from the moment 40 to 59 steps before it, with the history until then."""
    episodes, used = hurried(3, 0), grounding_model()
    windows, grounding = episodes.windows, HistoryGrounding(used)
    failures = FailureModel(FailureShape(4, 2, TASK.timestep_s, members=1)).eval()
    failures.set_move_scales(windows)
    seen = replayed_inputs(TASK, HistoryGrounding(used), failures, episodes)
    assert seen.shape == (3, 100, failures.shape.input_size)
    for episode, step, begun in ((1, 0, 0), (1, 59, 0), (0, 60, 20), (1, 79, 20), (1, 80, 40), (1, 99, 40)):
        world = grounding.corrected(TASK.simulator(1), None)
        state, before = windows.state[episode, begun][None], windows.previous_action[episode, begun][None]
        hidden = grounding.hidden_before(windows)[episode, begun][None]
        goal = windows.goal[episode, begun][None]
        world.start(state, ROW, goal, hidden=hidden, previous_action=before)
        memory = failures.initial_memory(state, before)
        for action in windows.action[episode, begun : step + 1]:
            here = world.state
            world.step(action[None])
            inputs, memory = failures.inputs(here, action[None], world.landed, memory)
        torch.testing.assert_close(seen[episode, step], inputs[0], atol=1e-4, rtol=1e-4)


def test_a_failure_model_remembers_what_a_replay_showed_it(monkeypatch: pytest.MonkeyPatch) -> None:
    episodes, used = hurried(3, 0), HistoryGrounding(grounding_model())
    windows = episodes.windows
    failures = FailureModel(FailureShape(4, 2, TASK.timestep_s, members=1)).eval()
    failures.set_move_scales(windows)
    drawn, seeds = torch.random.get_rng_state(), list[int]()
    monkeypatch.setattr(torch.cuda, "manual_seed_all", seeds.append)
    averages = averages_before(TASK, used, failures, episodes)
    assert torch.equal(torch.random.get_rng_state(), drawn)
    assert not seeds
    assert averages.shape == (3, 100, 15)
    assert not averages[:, 0].any()
    for episode, step, begun in ((1, 1, 0), (1, 60, 0), (0, 61, 20), (1, 99, 40)):
        world = used.corrected(TASK.simulator(1), None)
        state, before = windows.state[episode, begun][None], windows.previous_action[episode, begun][None]
        hidden = used.hidden_before(windows)[episode, begun][None]
        world.start(state, ROW, windows.goal[episode, begun][None], hidden=hidden, previous_action=before)
        memory = failures.initial_memory(state, before)
        for action in windows.action[episode, begun:step]:
            here = world.state
            world.step(action[None])
            _, memory = failures.inputs(here, action[None], world.landed, memory)
        torch.testing.assert_close(averages[episode, step], memory[0, -15:], atol=1e-4, rtol=1e-4)


def test_what_the_target_did_later_is_not_seen() -> None:
    episodes, used = hurried(2, 0), grounding_model()
    failures = FailureModel(FailureShape(4, 2, TASK.timestep_s, members=1)).eval()
    other = episodes.windows.state.clone()
    other[:, 41:60] += 1.0
    moved = replace(episodes, windows=replace(episodes.windows, state=other))
    seen, changed = (
        replayed_inputs(TASK, HistoryGrounding(used), failures, one) for one in (episodes, moved)
    )
    torch.testing.assert_close(seen[:, :100], changed[:, :100])
    assert not torch.allclose(seen, torch.zeros_like(seen))


def steps_left(episodes: PairedEpisodes) -> Tensor:
    return episodes.windows.mask.flip(1).cumsum(1).flip(1)


def test_the_windows_before_a_failure_are_ranked_against_calm_steps() -> None:
    """One episode fails after 60 steps: what is said is right 11 to 30 steps ahead alone."""
    episodes = hurried(2, 0)
    mask, soon = torch.ones(2, 100), torch.zeros(2, 100)
    mask[0, 60:], soon[0, 60 - RISK_STEPS : 60] = 0, 1
    episodes = replace(episodes, windows=replace(episodes.windows, mask=mask, fails_soon=soon))
    left = steps_left(episodes)
    said = torch.where((left >= 11) & (left <= 30) & (torch.arange(2) == 0)[:, None], 0.9, 0.1)
    auc = foresight(said, episodes)["auc"]
    # Ten of the twenty steps of the neighboring windows are above all calm ones, ten level with them.
    assert auc == {"1-20": pytest.approx(0.75), "11-30": 1.0, "21-40": pytest.approx(0.75)}
    # Before the last window of others, its steps are calm ones, too: 20 of 110 on the level.
    near = foresight(said, episodes, [(11, 20)])["auc"]
    assert near == {"11-20": pytest.approx((130 + 10 / 2) / 140)}


def test_to_say_the_rate_always_has_no_skill_and_is_reliable() -> None:
    episodes = hurried(20, 0)
    mask = episodes.windows.mask.bool()
    rate = float(episodes.windows.fails_soon[mask].mean())
    found = foresight(torch.full(mask.shape, rate), episodes)
    assert found["brier_skill"] == pytest.approx(0.0, abs=1e-6)
    assert found["auc"] == {"1-20": 0.5, "11-30": 0.5, "21-40": 0.5}
    assert found["reliability"] == [[pytest.approx(rate), pytest.approx(rate), int(mask.sum())]]


def test_episodes_without_a_failure_tell_nothing() -> None:
    episodes = hurried(2, 0)
    calm = replace(episodes, windows=replace(episodes.windows, fails_soon=torch.zeros(2, 100)))
    nothing = {"failures": 0, "auc": None, "brier_skill": None, "reliability": None}
    assert foresight(torch.rand(2, 100), calm) == nothing


def test_a_window_without_steps_has_no_figure() -> None:
    """Episodes of 25 steps, of which one fails: none is more than 25 steps before a failure."""
    episodes = hurried(2, 0)
    mask, soon = torch.ones(2, 100), torch.zeros(2, 100)
    mask[0, 25:], soon[0, 5:25] = 0, 1
    short = replace(episodes, windows=replace(episodes.windows, mask=mask, fails_soon=soon))
    found = foresight(torch.rand(2, 100), short)["auc"]
    assert found["1-20"] is not None and found["21-40"] is not None
    mask[0, 15:], soon[0] = 0, 0
    soon[0, :15] = 1
    found = foresight(torch.rand(2, 100), short)["auc"]
    assert found["1-20"] is not None and found["21-40"] is None
    soon[1], mask[1, 15:] = 1, 0
    assert foresight(torch.rand(2, 100), short)["brier_skill"] is None


def by_chance(seed: int) -> PairedEpisodes:
    """Forty episodes of which eight fail, whatever they look like."""
    episodes = hurried(40, seed)
    windows = episodes.windows
    torch.manual_seed(seed)
    action = 0.4 * torch.rand_like(windows.action) - 0.2
    soon, mask = torch.zeros(40, 100), torch.ones(40, 100)
    for episode, end in enumerate(torch.randint(30, 100, (8,)).tolist()):
        mask[episode, end:], soon[episode, end - RISK_STEPS : end] = 0, 1
    changed = replace(windows, action=action, fails_soon=soon, mask=mask)
    return replace(episodes, windows=changed)


def test_what_is_only_learned_by_heart_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without cross-fitting, chance failures are foreseen with confidence; with it, as often as they come."""
    training, fresh = by_chance(0), by_chance(1)

    def skill() -> float:
        model = fit_failures(TASK, HistoryGrounding(grounding_model()), training, 1, seed=0)
        found = foresight(said_of(model, fresh), fresh)
        return float(found["brier_skill"])

    calibrated = skill()
    monkeypatch.setattr("astra_data.grounding.failures.folds", lambda fails, recordings: [])
    assert skill() < calibrated - 0.02
    assert calibrated > -0.03


def test_every_step_is_cross_fitted_once_and_what_was_found_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[tuple[Tensor, Tensor]] = []

    def noted(odds: Tensor, fails: Tensor, risk_steps: int) -> tuple[Tensor, Tensor]:
        assert risk_steps == 7
        given.append((odds, fails))
        return torch.tensor(0.0), torch.tensor(-1.0)

    monkeypatch.setattr("astra_data.grounding.failures.calibration", noted)
    monkeypatch.setattr("astra_data.grounding.failures._DESCENT", DescentConfig(updates=4))
    episodes = hurried(10, 0)
    model = fit_failures(TASK, HistoryGrounding(grounding_model()), episodes, 3, 0, 7)
    ((odds, fails),) = given
    steps = int(episodes.windows.mask.sum())
    assert odds.shape == (3, steps) and fails.shape == (steps,)
    assert float(fails.sum()) == 7 * 5
    said = said_of(model, episodes)
    torch.testing.assert_close(said, torch.full_like(said, 1 / (1 + 2.718281828)))


@pytest.mark.parametrize("steps", [30, 60])
def test_calm_episodes_are_calm_however_short_they_are(steps: int) -> None:
    episodes = hurried(6, 0)
    mask, soon = torch.ones(6, steps), torch.zeros(6, steps)
    mask[0, 25:], soon[0, 5:25] = 0, 1
    windows = replace(episodes.windows, mask=mask, fails_soon=soon)
    found = foresight(soon.clone(), replace(episodes, windows=windows))["auc"]
    assert found == {"1-20": 1.0, "11-30": pytest.approx(5 / 6, abs=0.02), "21-40": 0.5}


def test_a_single_failure_leaves_nothing_to_cross_fit_and_is_foreseen_at_its_rate() -> None:
    training = by_chance(0)
    soon = training.windows.fails_soon.clone()
    soon[1:] = 0
    training = replace(training, windows=replace(training.windows, fails_soon=soon))
    model = fit_failures(TASK, HistoryGrounding(grounding_model()), training, 3, seed=0)
    rate = training.steps(soon).mean()
    torch.testing.assert_close(model.log_odds_shift, rate.logit() - torch.tensor(0.25).logit())
    assert float(training.steps(said_of(model, training)).mean()) == pytest.approx(float(rate), rel=0.5)


def test_heads_that_know_are_found_to_know(monkeypatch: pytest.MonkeyPatch) -> None:
    episodes, model = hurried(4, 0), grounding_model()
    soon = episodes.windows.fails_soon
    model.failure_weight.fill_(1.0)
    model.failure_cost.fill_(-10.0)
    parts = torch.stack([torch.ones_like(soon), -10.0 * soon / RISK_STEPS], dim=-1)
    monkeypatch.setattr(model, "predict_reward_parts", lambda latent, action: parts)
    monkeypatch.setattr(model, "topple_logit", lambda latent, action, after: 40.0 * (soon - 0.5))
    found = compared_foresight(TASK, HistoryGrounding(model), episodes, predicts_reward=True)
    skills = {head: round(told["brier_skill"], 4) for head, told in found.items()}
    assert skills == {"predicted_reward": 1.0, "topple_head": 1.0}
    other = compared_foresight(TASK, HistoryGrounding(model), episodes, predicts_reward=True, ahead=[(1, 5)])
    assert [list(told["auc"]) for told in other.values()] == [["1-5"], ["1-5"]]


def test_a_failure_model_is_measured_on_what_it_foresees(monkeypatch: pytest.MonkeyPatch) -> None:
    episodes = hurried(4, 0)
    failures = FailureModel(FailureShape(4, 2, TASK.timestep_s, members=1, risk_steps=3)).eval()
    soon = failing(TASK, episodes, 3).windows.fails_soon
    monkeypatch.setattr(failures, "probability", lambda inputs: soon)
    made = HistoryGrounding(grounding_model(), failures)
    found = compared_foresight(TASK, made, episodes, predicts_reward=False, ahead=[(1, 3)])
    assert found["failure_model"]["brier_skill"] == 1.0 and list(found["failure_model"]["auc"]) == ["1-3"]


def test_members_have_no_say_in_what_is_seen_of_a_step() -> None:
    episodes, used = hurried(2, 0), grounding_model()
    other = GroundingModel(used.shape).requires_grad_(False).eval()
    list(other.corrections.parameters())[-2].normal_(std=0.05)
    failures = FailureModel(FailureShape(4, 2, TASK.timestep_s, members=1)).eval()
    failures.set_move_scales(episodes.windows)
    alone, beside = (
        replayed_inputs(TASK, HistoryGrounding(used, members=members), failures, episodes)
        for members in ((), (other,))
    )
    assert torch.equal(alone, beside)


def test_inputs_are_seen_in_their_own_scale_and_weights_decay(monkeypatch: pytest.MonkeyPatch) -> None:
    training, grounding = hurried(6, 0), HistoryGrounding(grounding_model())
    model = fit_failures(TASK, grounding, training, 1, seed=0)
    seen = training.steps(replayed_inputs(TASK, grounding, model, training))
    torch.testing.assert_close(model.input_mean, seen.mean(0), atol=1e-5, rtol=1e-4)
    monkeypatch.setattr("astra_data.grounding.failures._WEIGHT_DECAY", 300.0)
    decayed = fit_failures(TASK, grounding, training, 1, seed=0)
    assert float(decayed.log_odds(seen).std()) < 0.1 * float(model.log_odds(seen).std())


def test_who_cross_fits_has_not_seen_the_fold(monkeypatch: pytest.MonkeyPatch) -> None:
    made, fitted = module._descended, list[tuple[FailureModel, FailureModel, Tensor]]()

    def noted(untrained: FailureModel, inputs: Tensor, fails: Tensor) -> FailureModel:
        model = made(untrained, inputs, fails)
        fitted.append((untrained, model, fails))
        return model

    monkeypatch.setattr(module, "_descended", noted)
    monkeypatch.setattr(module, "_DESCENT", DescentConfig(updates=4))
    episodes = hurried(10, 0)
    fit_failures(TASK, HistoryGrounding(grounding_model()), episodes, 1, 0, 7)
    begins, models, fails = zip(*fitted, strict=True)
    assert len(fitted) == 1 + 5
    assert all(begin is begins[0] and begin not in models for begin in begins)
    steps = int(episodes.windows.mask.sum())
    assert len(fails[0]) == steps
    assert sum(steps - len(one) for one in fails[1:]) == steps  # each step is left out once


def test_copies_of_one_failure_are_not_cross_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """All that fail are of the same recording: whoever is fitted to the others has seen no failure."""
    monkeypatch.setattr(module, "_DESCENT", DescentConfig(updates=4))
    monkeypatch.setattr(module, "calibration", lambda *_: pytest.fail("nothing was left out"))
    each = torch.arange(10)
    copied = replace(hurried(10, 0), recordings=torch.where(each % 2 == 0, 0, each))
    fit_failures(TASK, HistoryGrounding(grounding_model()), copied, 1, seed=0)


def test_where_whole_episodes_are_before_their_failure_probabilities_are_still_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of three episodes two fail, from their first step on: half of what is left out tells nothing."""
    monkeypatch.setattr(module, "_DESCENT", DescentConfig(updates=4))
    episodes = hurried(3, 0)
    model = fit_failures(TASK, HistoryGrounding(grounding_model()), episodes, 1, 0, 100)
    said = episodes.steps(said_of(model, episodes))
    assert ((said > 0) & (said < 1)).all()


def test_rewards_beyond_those_of_certain_failures_are_certainties(monkeypatch: pytest.MonkeyPatch) -> None:
    episodes, model = hurried(4, 0), grounding_model()
    soon = episodes.windows.fails_soon
    model.failure_weight.fill_(1.0)
    model.failure_cost.fill_(-10.0)
    failing = torch.where(soon.bool(), -30.0, 5.0) / RISK_STEPS
    parts = torch.stack([torch.ones_like(soon), failing], dim=-1)
    monkeypatch.setattr(model, "predict_reward_parts", lambda latent, action: parts)
    found = compared_foresight(TASK, HistoryGrounding(model), episodes, predicts_reward=True)
    assert found["predicted_reward"]["brier_skill"] == pytest.approx(1.0)


def test_reliability_is_what_was_said_beside_what_happened() -> None:
    """By the bins of 0.1 to 0.2 and 0.5 to 1: of the former nothing fails."""
    episodes = hurried(4, 0)
    soon = episodes.windows.fails_soon.bool()
    safe = episodes.windows.mask.bool() & ~soon & (torch.arange(100) % 2 == 0)
    found = foresight(torch.where(safe, 0.125, 0.75), episodes)["reliability"]
    calm, others = int(safe.sum()), int((episodes.windows.mask.bool() & ~safe).sum())
    assert found == [[0.125, 0.0, calm], [0.75, pytest.approx(int(soon.sum()) / others), others]]
