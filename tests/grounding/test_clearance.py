"""Corrections that end no closer to walls than the robot came in what was recorded."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from toy_episodes import toy_episodes

from astra_data.core.progress import silent
from astra_data.grounding.fit import Fitting, GroundConfig, HistoryFit, recorded_clearance_m
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.robots.registry import TASKS
from astra_data.worlds.task import Task

TASK = TASKS["antmaze-umaze"]
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
    given: list[float | None] = []

    def noted(task: Task, grounding: HistoryGrounding, *others: object) -> tuple[None, None]:
        given.append(grounding.clearance_m)
        return None, None

    monkeypatch.setattr("astra_data.grounding.fit.fit_failures", noted)
    monkeypatch.setattr("astra_data.grounding.fit.failure_figures", noted)
    monkeypatch.setattr("astra_data.grounding.fit.has_failures", lambda *_: True)
    training, held_out = recorded(*[1.0] * 10), recorded(*[0.5] * 10)
    config = GroundConfig(updates=1, batch_windows=1, window=2, latent_size=8)
    fitting = Fitting(task, config, None, training, held_out, 0, "cpu", tmp_path, silent)
    fit = HistoryFit(latent=False, reward=False, scatter=False, printed=printed)
    grounding, metrics = fit(fitting)
    assert grounding.fails_at_walls == at_walls
    expected = None if printed or at_walls else pytest.approx(1.0, abs=0.11)
    assert grounding.clearance_m == metrics.get("clearance_m") == given[0] == given[1] == expected
