from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_cart import Last, Reach

from astra_data.core.durable import held
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import (
    ACTION,
    DONE,
    GOAL,
    NEXT_STATE,
    OUTCOME_COLUMNS,
    REWARD,
    STATE,
    SUCCESS,
    TERMINATED,
    TRUNCATED,
    Clip,
    Column,
    Episode,
)
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter
from astra_data.io.hub.sharing import opened, push
from astra_data.pipeline.stages.label import check_fits, label, remarks, with_outcomes
from astra_data.robots.registry import task_named

CART = f"{Path(__file__).parents[2] / 'small_cart.py'}:LOGS_ALONE"
COLUMNS = (
    Column(STATE, size=2, names=("x", "speed")),
    Column(ACTION, size=1, names=("v",)),
    Column(NEXT_STATE, size=2, names=("x", "speed")),
)


def drive(speed: float, steps: int) -> dict[str, np.ndarray[Any, Any]]:
    x = 0.1 * speed * np.arange(steps + 1, dtype=np.float32)
    state = np.column_stack([x, np.full(steps + 1, speed)]).astype(np.float32)
    return {STATE: state[:-1], ACTION: np.full(steps, speed, np.float32), NEXT_STATE: state[1:]}


def write(folder: Path, episodes: list[Mapping[str, Any]], more: tuple[Column, ...] = (), **metadata: Any) -> Path:
    with DatasetWriter(
        folder, [*COLUMNS, *more], fps=10, task="drive", description={"name": "logs", "stage": "import"}
    ) as writer:
        for uid, columns in enumerate(episodes):
            writer.add(Episode(uid, dict(columns), metadata))
    return folder


def test_what_the_log_lacks_is_what_the_task_computes(tmp_path: Path) -> None:
    logs = write(tmp_path / "logs", [drive(0.5, 10), drive(4.0, 10)])
    notes = list[str]()
    out = label(CART, data=logs, out=tmp_path / "labeled", progress=lambda _, note: notes.append(note))
    labeled = Dataset.open(out)
    slow, fast = labeled.episodes()
    assert len(slow) == 10 and not slow.columns[SUCCESS].any() and not slow.columns[TERMINATED].any()
    np.testing.assert_allclose(slow.columns[REWARD], 0.05, atol=1e-6)
    assert slow.columns[TRUNCATED].tolist() == slow.columns[DONE].tolist() == [False] * 9 + [True]
    # 0.4 m a step: the episode ends with the step that reaches the goal, between 1 and 2 m.
    goal = float(fast.columns[GOAL][0])
    assert len(fast) == int(np.ceil(goal / 0.4)) and 1.0 <= goal <= 2.0
    assert fast.columns[SUCCESS].tolist() == fast.columns[TERMINATED].tolist() == [False] * (len(fast) - 1) + [True]
    assert not fast.columns[TRUNCATED].any()
    np.testing.assert_allclose(fast.columns[REWARD][-1], 10.4, atol=1e-5)
    assert labeled.metadata["success"] == [False, True] and labeled.metadata["failed"] == [False, False]
    assert labeled.metadata["return"] == pytest.approx([0.5, 10 + 0.4 * len(fast)], abs=1e-5)
    assert labeled.description["dropped_steps"] == 10 - len(fast) and labeled.reference == "logs@data-2.0.0"
    assert notes[-1] == f"1 successes, 0 failures in {10 + len(fast)} steps"
    filmed = Episode(1, drive(4.0, 10), {}, {"front": Clip(tmp_path / "a.mp4", "front", 0.0, 0.1, 10)})
    cut = with_outcomes(task_named(CART), filmed, 0)
    assert cut.cameras["front"].count == len(cut) < 10


def test_steps_that_do_not_lead_to_the_next_row_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    ahead = drive(0.5, 10)
    ahead[NEXT_STATE] = ahead[NEXT_STATE] + np.float32(0.01)
    told = f"steps whose {NEXT_STATE} is not the state of the next row: 9 of 9"
    labeled = label(CART, data=write(tmp_path / "logs", [ahead]), out=tmp_path / "out")
    assert told in caplog.text
    caplog.clear()
    label(CART, data=labeled, out=tmp_path / "linked")  # has all that a task asks for
    assert told in caplog.text


def test_goals_that_are_drawn_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    mistaken = Column("observation.goal")
    goals = {"observation.goal": np.ones(10, np.float32)}
    label(CART, data=write(tmp_path / "logs", [drive(0.5, 10) | goals], (mistaken,)), out=tmp_path / "out")
    told = f"logs@data-1.0.0 has no {GOAL} (observation.goal is not read as one): goals are drawn by the"
    assert told in caplog.text
    caplog.clear()
    known = {GOAL: np.ones(10, np.float32)}
    label(CART, data=write(tmp_path / "more", [drive(0.5, 10) | known], (Column(GOAL),)), out=tmp_path / "in")
    assert caplog.text == ""


def test_what_the_log_knows_is_kept(tmp_path: Path) -> None:
    fell = np.array([False] * 9 + [True])
    goal = Column(GOAL, size=1)
    given = drive(1.0, 10) | {TERMINATED: fell, GOAL: np.full(10, 0.95, np.float32)}
    more = (goal, *(column for column in OUTCOME_COLUMNS if column.name == TERMINATED))
    logs = write(tmp_path / "logs", [given], more, driver="Ada")
    labeled = Dataset.open(label(CART, data=logs, out=tmp_path / "labeled"))
    (episode,) = labeled.episodes()
    # It is at the goal when it falls: a failure.
    assert episode.columns[TERMINATED].tolist() == fell.tolist() and not episode.columns[SUCCESS].any()
    assert episode.columns[REWARD][-1] == pytest.approx(0.1 - 10.0)
    assert episode.columns[GOAL].tolist() == given[GOAL].tolist()
    assert dict(episode.metadata) == {
        **{"driver": "Ada", "success": False, "failed": True},
        "return": pytest.approx(-9.0),
    }


@pytest.mark.parametrize(
    ("ends", "more", "is_told"),
    [((True, True), (), True), ((True, False), (), False), ((True, True), (SUCCESS,), False)],
)
def test_failures_of_all_episodes_are_told(
    tmp_path: Path, ends: tuple[bool, bool], more: tuple[str, ...], is_told: bool
) -> None:
    last = np.arange(5) == 4
    episodes = [drive(0.1, 5) | {TERMINATED: last & end, SUCCESS: last & False} for end in ends]
    columns = [column for column in OUTCOME_COLUMNS if column.name in (TERMINATED, *more)]
    kept = {column.name for column in (*COLUMNS, *columns)}
    logs = write(tmp_path / "logs", [{key: one[key] for key in one if key in kept} for one in episodes], (*columns,))
    told = "logs@data-1.0.0: each of the 2 episodes ends as next.terminated and counts as a failure"
    assert any(remark.startswith(told) for remark in remarks(Dataset.open(logs), task_named(CART))) == is_told


@pytest.mark.parametrize(
    ("first", "last", "is_told"), [(0.95, 0.95, True), (1.9, 1.9, False), (1.9, 0.95, True), (0.95, 1.9, False)]
)
def test_who_terminates_at_the_goal_of_that_moment_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, first: float, last: float, is_told: bool
) -> None:
    """Goals may move: the cart ends at 1 m."""
    ended = drive(1.0, 10) | {TERMINATED: np.arange(10) == 9, GOAL: np.linspace(first, last, 10, dtype=np.float32)}
    more = (Column(GOAL), *(column for column in OUTCOME_COLUMNS if column.name == TERMINATED))
    label(CART, data=write(tmp_path / "logs", [ended, ended], more), out=tmp_path / "labeled")
    assert ("2 episodes terminate at their goal and are labeled as failures" in caplog.text) == is_told
    caplog.clear()
    known = ended | {SUCCESS: np.zeros(10, bool)}
    more = (Column(GOAL), *(column for column in OUTCOME_COLUMNS if column.name in (TERMINATED, SUCCESS)))
    label(CART, data=write(tmp_path / "more", [known], more), out=tmp_path / "known")
    assert caplog.text == ""


def test_who_falls_while_it_lasts_is_at_no_goal(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = replace(task_named(CART), objective=Last(horizon=10))
    monkeypatch.setattr("astra_data.pipeline.stages.label.task_named", lambda _: task)
    fell = drive(0.01, 5) | {TERMINATED: np.arange(5) == 4}
    more = tuple(column for column in OUTCOME_COLUMNS if column.name == TERMINATED)
    out = label(CART, data=write(tmp_path / "logs", [fell], more), out=tmp_path / "labeled")
    assert Dataset.open(out).metadata["failed"] == [True] and "at their goal" not in caplog.text


def test_whoever_lasts_to_the_horizon_succeeds(tmp_path: Path) -> None:
    task = replace(task_named(CART), objective=Last(horizon=10))
    short, long = (Episode(0, drive(0.01, steps), {}) for steps in (9, 10))
    assert not with_outcomes(task, short, 0).columns[SUCCESS].any()
    lasted = with_outcomes(task, long, 0)
    assert lasted.columns[SUCCESS].tolist() == [False] * 9 + [True]
    assert lasted.metadata["success"] and lasted.columns[TRUNCATED].tolist() == [False] * 9 + [True]
    fell = with_outcomes(task, Episode(0, dict(long.columns) | {TERMINATED: lasted.columns[TRUNCATED]}, {}), 0)
    assert not fell.columns[SUCCESS].any() and fell.metadata["failed"]
    for over in ({}, {TERMINATED: lasted.columns[TRUNCATED]}):
        told = with_outcomes(task, Episode(0, dict(long.columns) | over | {SUCCESS: lasted.columns[SUCCESS]}, {}), 0)
        assert told.metadata["success"] and not told.metadata["failed"] and not told.columns[TERMINATED].any()
        assert told.columns[TRUNCATED].tolist() == [False] * 9 + [True]


class ShortRail(Reach):
    """The rail ends after 1 m."""

    def missed(self, state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        return state[:, 0] > 1.0


def test_who_can_no_longer_reach_the_goal_has_failed() -> None:
    task = replace(task_named(CART), objective=ShortRail(horizon=40))
    given = drive(4.0, 10) | {GOAL: np.full(10, 1.9, np.float32)}
    labeled = with_outcomes(task, Episode(0, given, {}), 0)
    # 0.4 m a step: the third leaves the rail.
    assert labeled.columns[TERMINATED].tolist() == labeled.columns[DONE].tolist() == [False, False, True]
    assert labeled.columns[REWARD].tolist() == pytest.approx([0.4, 0.4, 0.4 - 10.0])
    assert labeled.metadata["failed"] and not labeled.metadata["success"]


def test_outcomes_are_those_of_the_steps_that_are_kept() -> None:
    recorded: dict[str, float | str] = {"success": False, "failed": True, "return": -3.0, "driver": "Ada"}
    labeled = with_outcomes(task_named(CART), Episode(0, drive(4.0, 10), recorded), 0)
    reward = float(labeled.columns[REWARD].sum(dtype=np.float64))
    outcome = {"success": True, "failed": False, "return": reward}
    assert len(labeled) < 10 and dict(labeled.metadata) == {"driver": "Ada"} | outcome


def test_the_seed_decides_the_goals(tmp_path: Path) -> None:
    logs = write(tmp_path / "logs", [drive(0.1, 3)] * 3)
    goals = [
        Dataset.open(label(CART, data=logs, seed=seed, out=tmp_path / f"{number}")).columns([GOAL])[GOAL]
        for number, seed in enumerate((0, 0, 1))
    ]
    assert np.array_equal(goals[0], goals[1]) and not np.array_equal(goals[0], goals[2])
    assert len(np.unique(goals[0])) == 3


def test_what_is_no_log_of_the_task_is_refused(tmp_path: Path) -> None:
    logs = write(tmp_path / "logs", [drive(0.1, 3)])
    with pytest.raises(BadInputError, match=r"observation.state has 2 values, expected those of antmaze-umaze: 29"):
        label("antmaze-umaze", data=logs, out=tmp_path / "out")
    numbers = write(
        tmp_path / "numbers", [drive(0.1, 3) | {TERMINATED: np.zeros(3, np.float32)}], (Column(TERMINATED),)
    )
    with pytest.raises(BadInputError, match=f"{TERMINATED} is float32, expected bool"):
        label(CART, data=numbers, out=tmp_path / "out")
    labeled = label(CART, data=logs, out=tmp_path / "labeled")
    with pytest.raises(BadInputError, match="already has goals and outcomes: there is nothing to label"):
        label(CART, data=labeled)
    assert not (tmp_path / "out").exists()


def test_a_dataset_of_another_rate_is_refused(tmp_path: Path) -> None:
    logs = Dataset.open(write(tmp_path / "logs", [drive(0.1, 3)]))
    task = task_named(CART)
    check_fits(logs, task)
    for timestep_s, fps in ((0.2, 5), (0.05, 20)):
        told = rf"has 10 steps per second, expected the {fps} of .*timestep_s is {timestep_s}"
        with pytest.raises(BadInputError, match=told):
            check_fits(logs, replace(task, timestep_s=timestep_s))


def test_what_lacks_nothing_is_linked_and_what_lies_elsewhere_is_pulled(
    tmp_path: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    labeled = label(CART, data=write(tmp_path / "logs", [drive(0.1, 3)]), out=tmp_path / "labeled")
    monkeypatch.chdir(tmp_path)
    link = label(CART, data="labeled", out=tmp_path / "run" / "seed_0")
    assert link.is_symlink() and Dataset.open(link).content_hash == Dataset.open(labeled).content_hash
    for taken in (link, labeled):
        with pytest.raises(BadInputError, match="exists already; delete it or choose another folder"):
            label(CART, data=labeled, out=taken)
    address = push(str(labeled), f"file://{tmp_path}/shared")

    def opened_alone(data: str) -> Dataset:
        with held(tmp_path / "run") as is_free:  # another seed would pull to the same place
            assert not is_free
        return opened(data)

    monkeypatch.setattr("astra_data.pipeline.stages.label.opened", opened_alone)
    pulled = label(CART, data=address, out=tmp_path / "run" / "seed_1")
    assert pulled.resolve() == home / "logs" / "data-2.0.0"
