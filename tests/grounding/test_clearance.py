"""Corrections that end no closer to walls than the robot came in what was recorded."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from toy_episodes import no_episodes, toy_episodes

from astra_data.core.progress import silent
from astra_data.grounding.clearance import recorded_clearance_m
from astra_data.grounding.failures import replayed_inputs
from astra_data.grounding.files import load_grounding, save_grounding
from astra_data.grounding.fit import Fitting, GroundConfig, HistoryFit
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.networks.failure import AHEAD_S, FailureModel, FailureShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.worlds.registry import TASKS
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


def pushed_up() -> GroundingModel:
    """Return a model that moves every state up by 0.04 m a step."""
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    with torch.no_grad():
        list(model.corrections[0].parameters())[-1][1] = 0.04
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
    padded = recorded_clearance_m(TASK, recorded(*far, 0.25, 0.25, 0.25, 0.25, 0.25, unreal=5))
    assert padded == pytest.approx(1.5, abs=0.11)


def test_there_is_none_without_walls() -> None:
    assert recorded_clearance_m(TASKS["humanoid-extended"], recorded(1.0, 1.0)) is None


def test_corrected_states_come_no_closer() -> None:
    assert highest_m(HistoryGrounding(pushed_up())) == pytest.approx(TOP_M - 0.2, abs=0.11)
    assert highest_m(HistoryGrounding(pushed_up(), clearance_m=0.7)) == pytest.approx(TOP_M - 0.7, abs=0.01)


def test_where_touches_are_failures_they_are_foreseen_as_close_to_walls_as_the_simulator_comes() -> None:
    """A failure model sees 0.2 m to the wall, where corrections for policies end 0.7 m from it."""
    ends_there = replace(TASK, objective=replace(TASK.objective, ends_at_walls=True))
    maze = TASK.objective.layout
    assert maze is not None
    failures = FailureModel(
        FailureShape(
            *(4, 2, TASK.timestep_s, (len(maze.fine_walls), len(maze.fine_walls[0])), maze.fine_m), members=1
        )
    ).eval()
    failures.clearance.copy_(torch.from_numpy(maze.clearance_field))
    failures.half_extent.copy_(torch.from_numpy(maze.half_extent))
    grounding = HistoryGrounding(pushed_up(), clearance_m=0.7)
    assert grounding.foreseeing(TASK.objective) is grounding
    assert grounding.foreseeing(ends_there.objective) == replace(grounding, clearance_m=None)
    upwards = toy_episodes(
        recorded(*[2.0] * 60).windows.state,
        torch.tensor([0.0, 1.0]).expand(1, 60, 2),
        next_state=recorded(*[2.0] * 60).windows.state,
    )
    for task, clearance in ((TASK, 0.7), (ends_there, 0.2)):
        seen = replayed_inputs(task, grounding, failures, upwards)[0, 40:]
        from_walls = seen[:, -1 - 2 * len(AHEAD_S)]
        assert float(from_walls.min()) == pytest.approx(clearance, abs=0.11)


def test_files_hold_it_and_are_as_before_without_it(tmp_path: Path) -> None:
    for clearance in (None, 0.7):
        path = tmp_path / f"{clearance}.safetensors"
        made = HistoryGrounding(pushed_up(), clearance_m=clearance)
        save_grounding(path, made, no_episodes())
        loaded = load_grounding(path)
        assert isinstance(loaded, HistoryGrounding) and loaded.clearance_m == clearance
        assert loaded.for_replay().clearance_m == clearance
        assert ("clearance_m" in made.to_file()[1]) == (clearance is not None)


@pytest.mark.parametrize("used", [False, True])
def test_a_fit_takes_it_from_its_training_episodes_if_it_is_asked_to(tmp_path: Path, used: bool) -> None:
    training, held_out = recorded(*[1.0] * 10), recorded(*[0.5] * 10)
    config = GroundConfig(updates=1, batch_windows=1, window=2, latent_size=8, recorded_clearance=used)
    fitting = Fitting(TASK, config, None, training, held_out, 0, "cpu", tmp_path, silent)
    grounding, metrics = HistoryFit(latent=False, reward=False)(fitting)
    assert ("clearance_m" in metrics) == ("recorded_clearance" in config.model_dump()) == used
    if used:
        assert grounding.clearance_m == metrics["clearance_m"] == pytest.approx(1.0, abs=0.11)
    else:
        assert grounding.clearance_m is None


def test_the_failure_model_is_fitted_to_replays_that_keep_clear(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[float | None] = []

    def noted(task: Task, grounding: HistoryGrounding, *others: object) -> None:
        given.append(grounding.clearance_m)

    monkeypatch.setattr("astra_data.grounding.fit.fit_failures", noted)
    monkeypatch.setattr("astra_data.grounding.fit.compared_foresight", lambda *_: {})
    failed = torch.zeros(1, 10)
    failed[0, -1] = 1.0
    training = recorded(*[1.0] * 10)
    training = replace(training, windows=replace(training.windows, fails_soon=failed))
    config = GroundConfig(
        updates=1,
        batch_windows=1,
        window=2,
        latent_size=8,
        recorded_clearance=True,
        failure_members=1,
        failure_steps=3,
    )
    fitting = Fitting(TASK, config, None, training, training, 0, "cpu", tmp_path, silent)
    HistoryFit(latent=False, reward=False)(fitting)
    assert given == [pytest.approx(1.0, abs=0.11)]


def test_two_of_100_steps_are_what_a_robot_can_rely_on() -> None:
    assert recorded_clearance_m(TASK, recorded(*[1.5] * 197, 0.25, 0.25, 0.25)) == pytest.approx(
        0.25, abs=0.11
    )
