from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from toy_episodes import toy_episodes

from astra_data.core.progress import silent
from astra_data.core.seeding import derive
from astra_data.grounding import fit as fit_module
from astra_data.grounding.fit import Fitting, GroundConfig, HistoryFit, _optimize, residual_rewards
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.descent import DescentConfig
from astra_data.learning.networks.grounding import GroundingModel, LossWeights
from astra_data.worlds.registry import TASKS


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
    going_on, failing = torch.tensor([[3.0, 0.0, 0.0, 2.0, 0.0]]), torch.tensor([[0.0, 0.0, -9.0, 0.0, 0.0]])
    still = torch.zeros(1, 5, 2)
    given = toy_episodes(
        torch.cat([before[None], still], dim=-1),
        still,
        next_state=torch.cat([after[None], still], dim=-1),
        goal=goal.expand(1, 5, 2),
        mask=torch.tensor([[1.0, 1.0, 1.0, 1.0, 0.0]]),
        parts=torch.stack([going_on, failing], dim=-1),
        reward=going_on + failing,
        terminated=terminated[None],
    )
    residual = residual_rewards(task, given).windows
    torch.testing.assert_close(residual.reward[0, :, 0], torch.tensor([3.0 - ahead, 0.0, 0.0, 0.0, 0.0]))
    torch.testing.assert_close(residual.reward[0, :, 1], torch.tensor([0.0, 0.0, -9.0 - ahead, 0.0, 0.0]))
    assert residual.goes_on[0, :4].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert residual.failed[0].tolist() == [0.0, 0.0, 1.0, 0.0, 0.0]


def test_balls_that_leave_the_field_are_no_failures_to_foresee() -> None:
    """Steps: the ball leaves the field, the robot falls."""
    task, goal = TASKS["nao-kick"], torch.tensor([1.5, 0.0])
    before = torch.zeros(1, 2, 8)
    after = before.clone()
    before[0, 0, 5], after[0, 0, 5] = 1.95, 2.05
    failing = torch.tensor([[-10.1, -9.9]])
    given = toy_episodes(
        before,
        torch.zeros(1, 2, 3),
        next_state=after,
        goal=goal.expand(1, 2, 2),
        parts=torch.stack([torch.zeros(1, 2), failing], dim=-1),
        reward=failing,
        terminated=torch.ones(1, 2, dtype=torch.bool),
    )
    residual = residual_rewards(task, given).windows
    assert residual.reward[0, :, 1].tolist() == pytest.approx([0.0, -9.9])
    assert residual.goes_on.sum() == 0 and residual.failed.tolist() == [[0.0, 1.0]]


def episodes(seed: int, count: int = 4) -> PairedEpisodes:
    """Return episodes of 10 steps whose simulator lacks a constant and noise; the last step of one fails."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.tensor([-4.0, 4.0, 0.0, 0.0]) + 0.1 * torch.randn(count, 11, 4, generator=generator)
    error = 0.3 + 0.1 * torch.randn(count, 10, 4, generator=generator)
    reward = torch.randn(count, 10, generator=generator)
    failing = torch.zeros(count, 10)
    failing[0, -1], reward[0, -1] = -10.0, 0.0
    terminated = failing != 0
    mask = torch.ones(count, 10)
    mask[1, 6:] = 0.0
    return toy_episodes(
        state[:, :-1],
        2 * torch.rand(count, 10, 2, generator=generator) - 1,
        next_state=state[:, 1:],
        simulated_next=state[:, 1:] - error,
        goal=torch.zeros(count, 10, 2),
        mask=mask,
        parts=torch.stack([reward, failing], dim=-1),
        reward=reward + failing,
        terminated=terminated,
    )


def fit(folder: Path, name: str, **settings: object) -> tuple[GroundingModel, Fitting]:
    (folder / name).mkdir()
    config = GroundConfig(updates=3, batch_windows=4, window=5, latent_size=8).model_copy(update=settings)
    task = TASKS["antmaze-umaze"]
    fitting = Fitting(task, config, None, episodes(0), episodes(1, 3), 0, "cpu", folder / name, silent)
    return HistoryFit(latent=True, reward=True)(fitting)[0].model, fitting


def test_scales_are_of_the_training_episodes_and_the_scatter_of_those_held_out(tmp_path: Path) -> None:
    model, fitting = fit(tmp_path, "fit", correction_heads=2)
    training, held_out = fitting.training, fitting.held_out
    torch.testing.assert_close(model.state_mean, training.steps(training.windows.state).mean(0))
    error = training.windows.next_state - training.windows.simulated_next
    torch.testing.assert_close(model.correction_std, training.steps(error).std(0))
    windows = held_out.windows
    model.requires_grad_(False)
    latent, _ = model.encode(windows)
    predictions = model.ensemble_predictions(latent, windows.action, windows.simulated_next)
    left = held_out.steps(windows.next_state - predictions.mean(0))
    scatter = model.residual_factor @ model.residual_factor.T
    torch.testing.assert_close(scatter, torch.cov(left.T), atol=1e-6, rtol=1e-3)
    # In its own unit, the heads' usual disagreement is one.
    assert float(held_out.steps(model.disagreement(predictions)).mean()) == pytest.approx(1.0, rel=1e-4)
    shape = model.shape
    assert (shape.latent_size, shape.correction_heads, shape.corrects_reward) == (8, 2, False)
    assert (shape.position_octaves, shape.ball_index, shape.goal_size) == (4, None, 2)


def test_members_are_fitted_to_draws_of_the_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[Fitting] = []

    def seen(
        model: GroundingModel, weights: LossWeights, fitting: Fitting, checkpoint: Path
    ) -> dict[str, Any]:
        fitted.append(fitting)
        return _optimize(model, weights, fitting, checkpoint)

    monkeypatch.setattr("astra_data.grounding.fit._optimize", seen)
    alone, _ = fit(tmp_path, "alone")
    fitted.clear()
    config = GroundConfig(updates=3, batch_windows=4, window=5, latent_size=8, members=2)
    (tmp_path / "three").mkdir()
    task, whole, held_out = TASKS["antmaze-umaze"], episodes(0), episodes(1, 3)
    folder, shares = tmp_path / "three", list[float]()
    given = Fitting(
        task, config, None, whole, held_out, 0, "cpu", folder, lambda share, _: shares.append(share)
    )
    grounding, metrics = HistoryFit(latent=True, reward=True)(given)
    # The model itself is what it is without members.
    assert all(map(torch.equal, grounding.model.state_dict().values(), alone.state_dict().values()))
    first, *draws = (one.training.windows.action for one in fitted)
    assert torch.equal(first, whole.windows.action) and len(grounding.members) == len(draws) == 2
    known = [row.tolist() for row in whole.windows.action]
    drawn = [[known.index(row.tolist()) for row in draw] for draw in draws]
    assert drawn[0] != drawn[1] and all(len(one) == len(whole) > len(set(one)) for one in drawn)
    weights = [one.encoder.embedding.weight for one in (grounding.model, *grounding.members)]
    assert not torch.equal(weights[0], weights[1]) and not torch.equal(weights[1], weights[2])
    windows = held_out.windows
    ways = [
        one.correct(one.encode(windows)[0], windows.action, windows.simulated_next)
        for one in (grounding.model, *grounding.members)
    ]
    for way, member in zip(ways[1:], grounding.members, strict=True):
        apart = held_out.steps(member.disagreement(torch.stack([ways[0], way])))
        assert float(apart.mean().detach()) == pytest.approx(1.0, rel=1e-4)
    assert len(metrics["members"]) == 2 and metrics["members"][0] != metrics["members"][1]
    assert shares == sorted(shares) and "members" not in GroundConfig().model_dump()


def test_the_slow_encoder_follows_at_its_rate(tmp_path: Path) -> None:
    rates = {rate: fit(tmp_path, str(rate), ema_rate=rate)[0] for rate in (0.0, 0.5, 1.0)}
    slow = {rate: model.target_encoder.embedding.weight for rate, model in rates.items()}
    fast = {rate: model.encoder.embedding.weight for rate, model in rates.items()}
    assert torch.equal(slow[1.0], fast[1.0])
    torch.manual_seed(derive(0, "grounding"))
    begun = GroundingModel(rates[0.0].shape)
    assert torch.equal(slow[0.0], begun.encoder.embedding.weight)
    assert not torch.equal(slow[0.5], slow[0.0]) and not torch.equal(slow[0.5], fast[0.5])


def test_the_residual_reward_is_fitted_where_it_is_asked_for(tmp_path: Path) -> None:
    whole, fitting = fit(tmp_path, "whole")
    residual, _ = fit(tmp_path, "residual", reward="correction")
    assert residual.shape.corrects_reward
    for model, given in (
        (whole, fitting.training),
        (residual, residual_rewards(fitting.task, fitting.training)),
    ):
        going_on, goes_on = given.windows.reward[..., 0], given.windows.goes_on.bool()
        paid = going_on[goes_on & given.windows.mask.bool()]
        assert float(model.reward_mean) == pytest.approx(float(paid.mean()), abs=1e-5)


def test_a_methods_weights_are_zero_where_it_predicts_nothing() -> None:
    config = GroundConfig(latent_weight=0.3, reward_weight=2.0)
    for latent in (False, True):
        for reward in (False, True):
            for failures in (False, True):
                weights = HistoryFit(latent=latent, reward=reward).weights(config, failures=failures)
                assert (weights.latent, weights.reward) == (0.3 * latent, 2.0 * reward)
                assert (weights.state, weights.failures) == (1.0, float(failures))


def test_no_failure_model_is_fitted_to_failures_that_abstract_states_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = episodes(0)
    soon = torch.zeros_like(training.windows.mask)
    soon[0, -4:] = 1
    training = replace(training, windows=replace(training.windows, fails_soon=soon))
    task = TASKS["antmaze-umaze"]
    monkeypatch.setattr(type(task.objective), "missed", lambda _, state, goal: state[:, 0] == state[:, 0])
    config = GroundConfig(updates=1, batch_windows=4, window=5, latent_size=8, failure_members=2)
    fitting = Fitting(task, config, None, training, training, 0, "cpu", tmp_path, silent)
    grounding, metrics = HistoryFit(latent=False, reward=False)(fitting)
    assert grounding.failures is None and set(metrics["failures"]) == {"topple_head"}


@pytest.mark.usefixtures("quick_failures")
def test_a_failure_model_is_fitted_and_compared_where_it_is_asked_for(tmp_path: Path) -> None:
    config = GroundConfig(updates=3, batch_windows=4, window=5, latent_size=8)
    training, held_out = episodes(0), episodes(1, 3)
    soon = torch.zeros_like(training.windows.mask)
    soon[0, -4:] = 1
    windows = replace(training.windows, fails_soon=soon, mask=torch.ones_like(soon))
    training = replace(training, windows=windows)
    for members in (0, 2):
        folder = tmp_path / f"{members}"
        folder.mkdir()
        asked = config.model_copy(update={"failure_members": members, "failure_steps": 3})
        given = Fitting(TASKS["antmaze-umaze"], asked, None, training, held_out, 0, "cpu", folder, silent)
        grounding, metrics = HistoryFit(latent=True, reward=True)(given)
        assert (grounding.failures is None) == (members == 0)
        assert ("failures" in metrics) == (members == 2)
        # It replaces the topple head, which is then not fitted.
        assert ("loss_topple" in metrics["epochs"][-1]) == (members == 0)
    assert grounding.failures is not None and len(grounding.failures.members) == 2
    assert grounding.failures.shape.risk_steps == 3
    # R_pred learned no failures then: there is nothing of it to compare.
    assert metrics["failures"].keys() == {"failure_model"}
    assert "failure_members" not in config.model_dump() and asked.model_dump()["failure_members"] == 2
    assert "failure_steps" not in config.model_dump() and asked.model_dump()["failure_steps"] == 3


@pytest.mark.usefixtures("quick_failures")
@pytest.mark.parametrize("reward", ["whole", "correction"])
def test_what_is_told_of_a_fit_is_measured_on_held_out_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reward: str
) -> None:
    monkeypatch.setattr("astra_data.grounding.scatter._DESCENT", DescentConfig(updates=3))
    given: dict[str, tuple[Any, ...]] = {}
    for name in ("telemetry", "fit_scatter", "compared_foresight"):
        made = getattr(fit_module, name)

        def noted(*args: Any, name: str = name, made: Any = made) -> Any:  # noqa: ANN401
            given[name] = args
            return made(*args)

        monkeypatch.setattr(fit_module, name, noted)
    _, fitting = fit(tmp_path, "fit", scatter=True, failure_members=1, reward=reward)
    training, held_out = fitting.training, fitting.held_out
    if reward == "correction":
        training, held_out = (residual_rewards(fitting.task, part) for part in (training, held_out))

    def is_alike(one: PairedEpisodes, other: PairedEpisodes) -> bool:
        first, second = one.windows, other.windows
        return torch.equal(first.state, second.state) and torch.equal(first.reward, second.reward)

    assert is_alike(given["telemetry"][1], held_out)
    assert is_alike(given["fit_scatter"][1], training) and is_alike(given["fit_scatter"][2], held_out)
    assert is_alike(given["compared_foresight"][2], held_out)


def test_failures_weigh_what_is_asked(tmp_path: Path) -> None:
    whole, half = (fit(tmp_path, str(of), failure_weight=of)[0] for of in (1.0, 0.5))
    assert 0 < float(half.failure_weight) == pytest.approx(0.5 * float(whole.failure_weight))


def test_members_cost_time_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spent = {"wall_seconds": 2.0, "cpu_seconds": 3.0, "epochs": [{}]}
    monkeypatch.setattr(fit_module, "_optimize", lambda *_: dict(spent))
    config = GroundConfig(updates=3, batch_windows=4, window=5, latent_size=8, members=2)
    parts = (episodes(0), episodes(1, 3))
    given = Fitting(TASKS["antmaze-umaze"], config, None, *parts, 0, "cpu", tmp_path, silent)
    _, metrics = HistoryFit(latent=True, reward=True)(given)
    assert (metrics["wall_seconds"], metrics["cpu_seconds"]) == (6.0, 9.0)


def test_states_without_a_place_are_seen_without_waves(tmp_path: Path) -> None:
    config = GroundConfig(updates=1, batch_windows=4, window=5, latent_size=8)
    nowhere = replace(TASKS["antmaze-umaze"], plane=None)
    fitting = Fitting(nowhere, config, None, episodes(0), episodes(1, 3), 0, "cpu", tmp_path, silent)
    assert HistoryFit(latent=True, reward=True)(fitting)[0].model.shape.position_octaves == 0


def test_each_model_has_its_share_of_the_progress(tmp_path: Path) -> None:
    config = GroundConfig(updates=20, batch_windows=1, window=2, latent_size=8, members=1)
    task, shares = TASKS["antmaze-umaze"], list[float]()
    parts = (episodes(0), episodes(1, 3))
    given = Fitting(task, config, None, *parts, 0, "cpu", tmp_path, lambda share, _: shares.append(share))
    HistoryFit(latent=False, reward=False)(given)
    assert shares == [0.25, 0.5, 0.75, 1.0]


def test_the_speed_of_a_fit_is_of_all_its_windows(tmp_path: Path) -> None:
    config = GroundConfig(updates=20, batch_windows=4, window=5, latent_size=8)
    parts = (episodes(0), episodes(1, 3))
    given = Fitting(TASKS["antmaze-umaze"], config, None, *parts, 0, "cpu", tmp_path, silent)
    _, metrics = HistoryFit(latent=True, reward=True)(given)
    assert metrics["windows_per_second"] * metrics["wall_seconds"] == pytest.approx(20 * 4, rel=0.5)


def failing_soon(count: int) -> PairedEpisodes:
    """Return episodes of 10 steps of which `count` fail within the last 4."""
    made = episodes(0)
    soon = torch.zeros_like(made.windows.mask)
    soon[:count, -4:] = 1
    windows = replace(made.windows, fails_soon=soon, mask=torch.ones_like(soon))
    return replace(made, windows=windows)


@pytest.mark.usefixtures("quick_failures")
def test_whether_failures_can_be_told_is_asked_of_as_many_steps_as_they_are_foreseen_in(
    tmp_path: Path,
) -> None:
    """All four fail within less than a second: each step is before a failure, but not just before it."""
    config = GroundConfig(updates=1, batch_windows=4, window=5, latent_size=8, failure_members=1)
    for steps, is_told in ((3, True), (20, False)):
        (tmp_path / str(steps)).mkdir()
        asked = config.model_copy(update={"failure_steps": steps})
        parts = failing_soon(4), episodes(1, 3)
        folder = tmp_path / str(steps)
        given = Fitting(TASKS["antmaze-umaze"], asked, None, *parts, 0, "cpu", folder, silent)
        assert (HistoryFit(latent=False, reward=False)(given)[0].failures is not None) == is_told


def test_all_parts_of_a_fit_are_of_its_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: dict[str, int] = {}

    def scatter(*given: Any) -> tuple[None, dict[str, Any]]:  # noqa: ANN401
        seeds["scatter"] = given[-1]
        return None, {}

    def failures(*given: Any) -> None:  # noqa: ANN401
        seeds["failures"] = given[-2]

    monkeypatch.setattr(fit_module, "fit_scatter", scatter)
    monkeypatch.setattr(fit_module, "fit_failures", failures)
    monkeypatch.setattr(fit_module, "compared_foresight", lambda *_: {})
    config = GroundConfig(
        updates=1, batch_windows=4, window=5, latent_size=8, failure_members=1, scatter=True
    )
    parts = failing_soon(1), episodes(1, 3)
    given = Fitting(TASKS["antmaze-umaze"], config, None, *parts, 5, "cpu", tmp_path, silent)
    HistoryFit(latent=False, reward=False)(given)
    assert seeds == {"scatter": 5, "failures": 5}
