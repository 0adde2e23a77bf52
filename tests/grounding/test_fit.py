from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch
from toy_episodes import toy_episodes

from astra_data.core.progress import Progress, silent
from astra_data.grounding import fit as fit_module
from astra_data.grounding.encoder import HistoryEncoder
from astra_data.grounding.fit import Fitting, GroundConfig, HistoryFit, recorded_clearance_m, with_own_rewards
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.navigation import Navigation
from astra_data.worlds.task import Task


def test_residual_rewards_are_what_abstract_states_do_not_explain() -> None:
    """Steps: ahead, into the goal, failing unseen, into a goal that only abstract states show, none."""
    task = TASKS["antmaze-umaze"]
    goal = torch.tensor(task.maze.cell_center(*task.maze.goal)).float()
    away, near, there = (goal + torch.tensor([shift, 0.0]) for shift in (2.0, 1.0, 0.0))
    after = torch.stack([near, there, near, there, goal])
    before = torch.stack([away, near, away, near, goal])
    terminated = torch.tensor([False, True, True, False, False])
    ahead = float(task.objective.reward(away[None], near[None], goal[None], torch.zeros(1, dtype=torch.bool)))
    assert 0.1 < ahead < 2.0
    reward, failed = torch.tensor([[3.0, 5.0, -9.0, 2.0, 0.0]]), torch.tensor([[0.0, 0.0, 1.0, 1.0, 0.0]])
    still = torch.zeros(1, 5, 2)
    given = toy_episodes(
        torch.cat([before[None], still], dim=-1),
        still,
        next_state=torch.cat([after[None], still], dim=-1),
        goal=goal.expand(1, 5, 2),
        mask=torch.tensor([[1.0, 1.0, 1.0, 1.0, 0.0]]),
        reward=reward,
        failed=failed,
        terminated=terminated[None],
    )
    residual = with_own_rewards(task, given).windows
    assert residual.own_reward is not None and torch.equal(residual.reward, reward)
    left = (residual.reward - residual.own_reward)[0, [0, 2]]
    torch.testing.assert_close(left, torch.tensor([3.0 - ahead, -9.0 - ahead]))
    assert residual.goes_on[0].tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]
    assert residual.failed[0].tolist() == [0.0, 0.0, 1.0, 0.0, 0.0]


pytestmark = pytest.mark.usefixtures("quick_fits")
TASK = TASKS["antmaze-umaze"]


def episodes(seed: int, count: int = 4, failing: int = 1) -> PairedEpisodes:
    """Return episodes of 10 steps whose simulator lacks a constant and noise; so many of them fail."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.tensor([-4.0, 4.0, 0.0, 0.0]) + 0.1 * torch.randn(count, 11, 4, generator=generator)
    error = 0.3 + 0.1 * torch.randn(count, 10, 4, generator=generator)
    mask, failed, soon = torch.ones(count, 10), torch.zeros(count, 10), torch.zeros(count, 10)
    failed[:failing, -1] = soon[:failing] = 1.0
    if failing < 2:
        mask[1, 6:] = 0.0
    made = toy_episodes(
        state[:, :-1],
        2 * torch.rand(count, 10, 2, generator=generator) - 1,
        next_state=state[:, 1:],
        simulated_next=state[:, 1:] - error,
        goal=torch.zeros(count, 10, 2),
        mask=mask,
        reward=torch.randn(count, 10, generator=generator) - 10.0 * failed,
        failed=failed,
    )
    return replace(made, windows=replace(made.windows, fails_soon=soon))


def fit(
    folder: Path,
    of: HistoryFit | None = None,
    *,
    task: Task = TASK,
    failing: int = 1,
    seed: int = 0,
    progress: Progress = silent,
    **settings: Any,
) -> tuple[HistoryGrounding, dict[str, Any], Fitting]:
    config = GroundConfig(updates=3, batch_windows=4, window=5, latent_size=8).model_copy(update=settings)
    training, held_out = episodes(0, failing=failing), episodes(1, 3, failing=min(failing, 2))
    fitting = Fitting(task, config, None, training, held_out, seed, "cpu", folder, progress)
    return *(of or HistoryFit(latent=True, reward=True))(fitting), fitting


def test_scales_and_sizes_are_of_the_training_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grounding, metrics, fitting = fit(tmp_path, window=12)
    model, training = grounding.model, fitting.training
    torch.testing.assert_close(model.state_mean, training.steps(training.windows.state).mean(0))
    error = training.windows.next_state - training.windows.simulated_next
    torch.testing.assert_close(model.correction_std, training.steps(error).std(0))
    shape = model.shape
    assert (shape.latent_size, shape.corrects_reward, shape.goal_size) == (8, True, 2)
    assert (shape.position_octaves, shape.ball_index) == (4, None)
    assert (metrics["updates"], metrics["window"], len(metrics["epochs"])) == (3, 10, 1)
    assert grounding.scatter_model is not None and fitting.descent.updates == 3
    assert len(grounding.scatter_model.forms) == 26  # residuals of held-out steps
    loss, _ = model.losses(with_own_rewards(TASK, fitting.held_out).windows, LossWeights(latent=0.0))
    assert metrics["epochs"][0]["held_out_error"] == pytest.approx(float(loss.detach()))
    assert replace(fitting, config=GroundConfig(batch_windows=1, window=1)).descent.updates == 32 * 36
    of = HistoryFit(latent=False, reward=False, failures=False, scatter=False)
    placeless = replace(TASK, quantities={"ball_position_m": (2, 3)})
    monkeypatch.setattr(Task, "plane", None)
    grounding, metrics, _ = fit(tmp_path / "placeless", of, task=placeless)
    shape = grounding.model.shape
    assert (shape.position_octaves, shape.ball_index) == (0, 2)
    assert not {"loss_latent", "loss_reward"} & metrics["epochs"][0].keys()
    seen: list[int] = []
    monkeypatch.setattr("astra_data.grounding.encoder.check_encoder", lambda _, inputs: seen.append(inputs.shape[1]))
    monkeypatch.setattr(Task, "ball_rolls", True)
    own, _, _ = fit(tmp_path / "own", replace(of, encoder=HistoryEncoder), task=placeless, window=8)
    assert seen == [8] and own.model.shape.ball_rolls


def test_all_that_is_drawn_comes_from_the_seed(tmp_path: Path) -> None:
    of = HistoryFit(latent=False, reward=False, failures=False, scatter=False)

    def weights(name: str, progress: Progress = silent, **settings: Any) -> torch.Tensor:
        model = fit(tmp_path / name, of, updates=11, progress=progress, **settings)[0].model
        return torch.cat([parameter.flatten() for parameter in model.parameters()])

    def disturb(share: float, note: str) -> None:
        torch.manual_seed(5)

    assert torch.equal(weights("once"), weights("again", disturb))
    begun = [weights(f"seed {seed}", seed=seed, learning_rate=1e-12) for seed in (0, 1)]
    assert (begun[0] - begun[1]).abs().max() > 0.01


@pytest.mark.parametrize("printed", [False, True])
@pytest.mark.parametrize("failures", [False, True])
def test_residuals_are_learned_by_default_and_the_whole_reward_as_printed(
    tmp_path: Path, printed: bool, failures: bool
) -> None:
    """Failures are among it, unless a failure model predicts them: then they cost more than its mean."""
    of = HistoryFit(latent=True, reward=True, failures=failures, scatter=False, printed=printed)
    grounding, metrics, fitting = fit(tmp_path, of)
    model, windows = grounding.model, fitting.training.windows
    assert model.shape.corrects_reward is ("reward_shrinkage" in metrics) is not printed
    assert (grounding.failures is not None) == failures
    paid = windows.reward
    if not printed:
        before, after, goal = (one.flatten(0, 1) for one in (windows.state, windows.next_state, windows.goal))
        nowhere = torch.zeros(len(goal), dtype=torch.bool)
        paid = paid - TASK.objective.reward(before, after, goal, nowhere).view(paid.shape)
    real, failed = windows.mask.bool(), windows.failed.bool()
    mean = paid[real & ~failed].mean() if failures else paid[real].mean()
    torch.testing.assert_close(model.reward_mean[-1], mean)
    torch.testing.assert_close(model.failure_cost, paid[failed].mean() - mean)
    if not printed:
        held_out = with_own_rewards(TASK, fitting.held_out).windows
        if not failures:
            held_out = replace(held_out, goes_on=held_out.goes_on + held_out.failed)
        assert metrics["reward_shrinkage"] == float(model.reward_shrinkage)
        model.shrink_reward(held_out)
        assert metrics["reward_shrinkage"] == float(model.reward_shrinkage)


def test_what_a_reward_says_of_padding_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    given = episodes(0)
    monkeypatch.setattr(Navigation, "reward", lambda self, before, after, goal, failed: 1.0 / after.norm(dim=-1))
    windows = replace(given.windows, next_state=given.windows.next_state * given.windows.mask.unsqueeze(-1))
    own = with_own_rewards(TASK, replace(given, windows=windows)).windows.own_reward
    assert own is not None and own.isfinite().all() and torch.equal(own > 0, windows.mask.bool())


def test_it_returns_to_the_weights_with_the_least_held_out_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, errors = list[dict[str, torch.Tensor]](), iter([2.0, 1.0, 3.0, 1.5, 4.0])

    def measured(model: GroundingModel, held_out: PairedEpisodes, weights: LossWeights) -> float:
        assert not model.training and weights == LossWeights(latent=0.2, reward=0.3)
        seen.append({name: values.clone() for name, values in model.state_dict().items()})
        return next(errors)

    monkeypatch.setattr(fit_module, "_MEASURED_EVERY", 1)
    monkeypatch.setattr(fit_module, "_held_out_error", measured)
    of = HistoryFit(latent=True, reward=True, printed=True)
    grounding, metrics, _ = fit(tmp_path, of, updates=5, latent_weight=0.2, reward_weight=0.3)
    assert metrics["updates"] == 2 and len(seen) == 4  # three tenths of five updates are awaited
    kept = grounding.model.state_dict()
    assert not grounding.model.training
    assert all(torch.equal(kept[name], values) for name, values in seen[1].items())
    assert [point["held_out_error"] for point in metrics["epochs"]] == [2.0, 1.0, 3.0, 1.5]


def test_the_slow_encoder_follows_in_each_update(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("astra_data.grounding.model._EMA_RATE", 1.0)
    model = fit(tmp_path)[0].model
    slow, fast = model.target_encoder.state_dict(), model.encoder.state_dict()
    assert all(torch.equal(slow[name], fast[name]) for name in fast)


TOP_M = 6.0
"""The wall that is nearest to everybody here is at y = 6 m."""


def recorded(*clearances_m: float, unreal: int = 0) -> PairedEpisodes:
    """Return one episode that is so far from the wall at its steps; the last `unreal` of them are padding."""
    steps = len(clearances_m)
    state = torch.zeros(1, steps, 4)
    state[..., 0], state[..., 1] = -4.0, TOP_M - torch.tensor(clearances_m)
    mask = torch.ones(1, steps)
    mask[0, steps - unreal :] = 0.0
    return toy_episodes(state, torch.zeros(1, steps, 2), next_state=state, mask=mask)


def pushed_up(by_m: float = 0.04) -> GroundingModel:
    """Return a model that moves every state up by so much a step."""
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    with torch.no_grad():
        list(model.correction.parameters())[-1][1] = by_m
    return model.requires_grad_(False)


def highest_m(grounding: HistoryGrounding) -> float:
    world = grounding.simulator(TASK, 1)
    world.start(torch.tensor([[-4.0, 4.0, 0.0, 0.0]]), torch.tensor([0]), torch.zeros(1, 2))
    return max(float(world.step(torch.tensor([[0.0, 1.0]]))[0, 1]) for _ in range(40))


def test_what_is_recorded_is_the_distance_that_99_of_100_steps_keep() -> None:
    far = [1.5] * 195
    # Five of 200 steps are near the wall, one of them closest: a hundredth is two.
    clearance = recorded_clearance_m(TASK, recorded(*far, 0.75, 0.75, 0.75, 0.75, 0.25))
    assert clearance == pytest.approx(0.75, abs=0.11)
    closest = recorded_clearance_m(TASK, recorded(*far, 0.25, 0.25, 0.25, 0.25, 0.25))
    assert closest == pytest.approx(0.25, abs=0.11)
    rare = recorded_clearance_m(TASK, recorded(*[1.5] * 197, 0.25, 0.25, 0.25))
    assert rare == pytest.approx(0.25, abs=0.11)
    padded = recorded_clearance_m(TASK, recorded(*far, 0.25, 0.25, 0.25, 0.25, 0.25, unreal=5))
    assert padded == pytest.approx(1.5, abs=0.11)


def test_corrected_states_come_no_closer() -> None:
    assert highest_m(HistoryGrounding(pushed_up())) == pytest.approx(TOP_M - 0.2, abs=0.11)
    assert highest_m(HistoryGrounding(pushed_up(), clearance_m=0.7)) == pytest.approx(TOP_M - 0.7, abs=0.01)


@pytest.mark.parametrize(("printed", "at_walls"), [(False, False), (True, False), (False, True)])
def test_a_fit_takes_it_from_its_training_episodes_but_as_printed_and_where_touches_are_failures(
    tmp_path: Path, printed: bool, at_walls: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Failure models are fitted to replays that keep clear."""
    task = replace(TASK, objective=replace(TASK.objective, ends_at_walls=at_walls))
    given, seen = list[float | None](), list[PairedEpisodes]()

    def noted(task: Task, grounding: HistoryGrounding, *others: Any) -> tuple[MagicMock, None]:
        given.append(grounding.clearance_m)
        seen.extend(one for one in others if isinstance(one, PairedEpisodes))
        return MagicMock(), None

    monkeypatch.setattr("astra_data.grounding.failures.fit_failures", noted)
    monkeypatch.setattr("astra_data.grounding.failures.replayed_inputs", noted)
    monkeypatch.setattr("astra_data.grounding.failures.failure_skill", lambda *_: None)
    monkeypatch.setattr("astra_data.grounding.failures.has_failures", lambda *_: True)
    training, held_out = recorded(*[1.0] * 10), recorded(*[0.5] * 10)
    config = GroundConfig(updates=1, batch_windows=1, window=2, latent_size=8)
    fitting = Fitting(task, config, None, training, held_out, 0, "cpu", tmp_path, silent)
    grounding, metrics = HistoryFit(latent=False, reward=False, scatter=False, printed=printed)(fitting)
    assert grounding.fails_at_walls == at_walls
    assert [float(one.windows.state[0, 0, 1]) for one in seen] == [TOP_M - 1.0, TOP_M - 0.5]
    expected = None if printed or at_walls else pytest.approx(1.0, abs=0.11)
    assert grounding.clearance_m == metrics.get("clearance_m") == given[0] == given[1] == expected
