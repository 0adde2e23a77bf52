import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from small_cart import TASK

from astra_data.deployment.folder import describe
from astra_data.deployment.graph import write_graphs
from astra_data.deployment.run_policy import RobotPolicy, run
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.training.running_policy import RunningPolicy


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("cart")
    torch.manual_seed(0)
    deployed = RunningPolicy(TASK, ActorCritic(ActorCriticShape(2, 1, memory_size=4)))
    written = write_graphs(deployed, made)
    (made / "policy.json").write_text(json.dumps(describe(deployed, written.parts)))
    return made


GIVEN: dict[str, Any] = {"rate_hz": 10, "state": ["x", "speed"], "goal": ["goal_0"]}


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"rate_hz": 20}, "rate_hz: expected 10, got 20"),
        ({"rate_hz": 10.5}, "rate_hz: expected 10, got 10.5"),
        ({"rate_hz": 5}, "rate_hz: expected 10, got 5"),
        ({"state": ["speed", "x"]}, r"state: expected the values \['x', 'speed'\], got \['speed', 'x'\]"),
        ({"state": ["x"]}, r"state: expected the values \['x', 'speed'\], got \['x'\]"),
        ({"goal": []}, r"goal: expected the values \['goal_0'\], got \[\]"),
    ],
)
def test_another_rate_and_other_values_are_refused(wrong: dict[str, Any], told: str, folder: Path) -> None:
    with pytest.raises(ValueError, match=told):
        RobotPolicy(**GIVEN | wrong, folder=folder)


@pytest.mark.parametrize(
    ("state", "goal", "told"),
    [
        ([0.0, np.nan], [1.0], r"state: expected 2 finite values \['x', 'speed'\], got \[0.0, nan\]"),
        ([0.0], [1.0], "state: expected 2 finite values"),
        ([[0.0, 0.0]], [1.0], "state: expected 2 finite values"),
        ([0.0, 0.0], [np.inf], r"goal: expected 1 finite values \['goal_0'\], got \[inf\]"),
        ([0.0, 0.0], [], "goal: expected 1 finite values"),
    ],
)
def test_values_that_are_none_are_refused_and_forgotten(
    state: list[Any], goal: list[float], told: str, folder: Path
) -> None:
    policy = RobotPolicy(**GIVEN, folder=folder)
    with pytest.raises(ValueError, match=told):
        policy.act(state, goal)
    assert not policy.hidden.any()


def test_a_command_that_is_none_is_refused(folder: Path) -> None:
    policy = RobotPolicy(**GIVEN, folder=folder)
    policy.hidden[:] = np.nan
    with pytest.raises(ValueError, match=r"the policy gives no command for the state \[0, 0\]"):
        policy.act([0, 0], [1])


def test_the_loop_keeps_the_rate_and_begins_without_memory(folder: Path) -> None:
    policy = RobotPolicy(**GIVEN | {"rate_hz": 10.05}, folder=folder)  # as good as 10
    sent: list[Any] = []
    policy.about["rate_hz"] = 1000.0
    first = policy.act([0.5, 1.0], [1.0])
    assert first.shape == (1,) and policy.hidden.any()
    run(policy, lambda: [0.5, 1.0], sent.append, [1.0], steps=3, stop=[-1.0])
    assert len(sent) == 4 and sent[-1].tolist() == [-1.0]
    np.testing.assert_array_equal(sent[0], first)
    assert not np.array_equal(sent[1], first)


def test_the_loop_sleeps_what_the_policy_leaves_of_a_period(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that only measuring and sleeping move: 20 ms, then 150 ms, then 20 ms again, at 10 Hz."""
    now, slept, took = [100.0], list[float](), iter((0.02, 0.15, 0.02))

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += seconds

    def measure() -> list[float]:
        now[0] += next(took)
        return [0.5, 1.0]

    monkeypatch.setattr("astra_data.deployment.run_policy.time.perf_counter", lambda: now[0])
    monkeypatch.setattr("astra_data.deployment.run_policy.time.sleep", sleep)
    policy = RobotPolicy(**GIVEN, folder=folder)
    policy.about["rate_hz"] = 10.0
    run(policy, measure, lambda command: None, [1.0], steps=3, stop=[0.0])
    # The period that took too long is not made up for: the state is never measured twice within a period.
    assert slept == pytest.approx([0.08, 0.0, 0.08])


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_the_robot_is_stopped_whatever_happens(folder: Path, error: type[BaseException]) -> None:
    policy = RobotPolicy(**GIVEN, folder=folder)
    policy.about["rate_hz"] = 1000.0
    sent: list[Any] = []
    states = iter([[0.5, 1.0]])

    def measure() -> list[float]:
        for state in states:
            return state
        raise error("no state any more")

    with pytest.raises(error):
        run(policy, measure, sent.append, [1.0], steps=9, stop=[0.25])
    assert len(sent) == 2 and sent[-1].tolist() == [0.25]


def test_a_robot_that_holds_its_position_gets_no_other_command(folder: Path) -> None:
    policy = RobotPolicy(**GIVEN, folder=folder)
    policy.about["rate_hz"] = 1000.0
    sent: list[Any] = []
    run(policy, lambda: [0.5, 1.0], sent.append, [1.0], steps=3, stop=None)
    assert len(sent) == 3 and sent[-1].any()


@pytest.mark.parametrize("stop", [[], [0.0, 0.0], [np.nan]])
def test_what_cannot_stop_the_robot_is_refused_before_it_moves(folder: Path, stop: list[float]) -> None:
    sent: list[Any] = []
    with pytest.raises(ValueError, match=r"stop: expected 1 finite values \['v'\], got"):
        run(RobotPolicy(**GIVEN, folder=folder), lambda: [0.5, 1.0], sent.append, [1.0], steps=3, stop=stop)
    assert not sent


def test_a_refused_command_is_not_remembered(folder: Path) -> None:
    policy = RobotPolicy(**GIVEN, folder=folder)
    policy.act([0.5, 1.0], [1.0])
    before = policy.hidden.copy()
    none = [np.full((1, 1), np.nan, np.float32), np.full_like(before, np.nan)]
    policy.session = SimpleNamespace(run=lambda *_: none)
    with pytest.raises(ValueError, match="the policy gives no command"):
        policy.act([0.5, 1.0], [1.0])
    np.testing.assert_array_equal(policy.hidden, before)
