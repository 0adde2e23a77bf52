import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from small_cart import TASK

from astra_data.core.artifact import write_manifest
from astra_data.deployment.folder import describe
from astra_data.deployment.graph import write_graph
from astra_data.deployment.run_policy import RobotPolicy, refuse_far, run
from astra_data.policies.networks import ActorCritic, PolicyShape
from astra_data.policies.running_policy import RunningPolicy


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("cart")
    torch.manual_seed(0)
    deployed = RunningPolicy(TASK, ActorCritic(PolicyShape(2, 1, memory_size=4)))
    parts, _ = write_graph(deployed, made)
    recorded = ([-0.5, 0.0], [1.0, 2.0])
    (made / "policy.json").write_text(json.dumps(describe(deployed, parts, recorded)))
    write_manifest(made, {})
    return made


GIVEN: dict[str, Any] = {"rate_hz": 10, "state": ["x", "speed"], "goal": ["goal_0"]}


@pytest.mark.parametrize("name", ["policy.onnx", "policy.json"])
def test_of_altered_files_no_policy_is_made(name: str, folder: Path, tmp_path: Path) -> None:
    """Whichever bit is another, and where: also where the command would be another one, or none."""
    copied = Path(shutil.copytree(folder, tmp_path / "robot"))
    whole = (copied / name).read_bytes()
    for bit in np.random.default_rng(0).integers(8 * len(whole), size=50).tolist():
        altered = bytearray(whole)
        altered[bit // 8] ^= 1 << bit % 8
        (copied / name).write_bytes(altered)
        with pytest.raises(ValueError, match=rf"{name} was altered: copy the folder again"):
            RobotPolicy(**GIVEN, folder=copied)
    (copied / name).unlink()
    with pytest.raises(ValueError, match=r"expected policy\.json, policy\.onnx and manifest\.json as"):
        RobotPolicy(**GIVEN, folder=copied)


@pytest.mark.parametrize("content", ["", "[]", '{"files": {"policy.json": 1}}'])
def test_without_its_manifest_no_policy_is_made(content: str, folder: Path, tmp_path: Path) -> None:
    copied = Path(shutil.copytree(folder, tmp_path / "robot"))
    (copied / "manifest.json").write_text(content)
    with pytest.raises(ValueError, match=r"as astra-data deploy wrote them, got .*: copy the folder again"):
        RobotPolicy(**GIVEN, folder=copied)


@pytest.mark.parametrize(
    ("state", "refused"),
    [
        ([1.0, 2.0], ""),
        ([6.9, -9.9], ""),  # 1.5 and 2 wide: up to 5 of these beyond either end
        ([500.0, 0.5], "state: x is 500, recorded is -0.5 to 1: give it in that unit"),
        ([-9.5, 0.5], "x is -9.5"),
        ([0.5, 57.3], "speed is 57.3, recorded is 0 to 2"),
    ],
)
def test_a_state_far_outside_what_was_recorded_is_refused(state: list[float], refused: str, folder: Path) -> None:
    policy = RobotPolicy(**GIVEN, folder=str(folder))
    if not refused:
        assert policy.act(state, [1.0]).shape == (1,)
        return
    with pytest.raises(ValueError, match=refused):
        policy.act(state, [1.0])
    assert not policy.hidden.any()


def test_ranges_that_are_not_known_or_have_no_width_refuse_nothing() -> None:
    refuse_far(np.array([9e9]), {"names": ["x"]})
    refuse_far(np.array([9e9]), {"names": ["x"], "recorded_least": [0.0], "recorded_largest": [0.0]})
    about = {"names": ["x"], "recorded_least": [3.0], "recorded_largest": [3.0], "units": ["m"]}
    refuse_far(np.array([17.9]), about)
    with pytest.raises(ValueError, match="x is 3000, recorded is 3 to 3 m: give it in that unit"):
        refuse_far(np.array([3000.0]), about)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"rate_hz": "20"}, "rate_hz: expected 10, got 20"),
        ({"rate_hz": 9.8}, "rate_hz: expected 10, got 9.8"),
        ({"rate_hz": float("nan")}, "rate_hz: expected 1 finite value"),
        ({"rate_hz": None}, "rate_hz: expected 1 finite value"),
        ({"state": None}, r"state: expected the values \['x', 'speed'\], got None"),
        ({"state": ["speed", "x"]}, r"state: expected the values \['x', 'speed'\], got \['speed', 'x'\]"),
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
        (np.zeros((5, 2)), [1.0], r"got array\(\[\[0., 0.\], \[0., 0.\],.* of the shape \(5, 2\)$"),
        ([0.0, 1e300], [1.0], r"state: expected 2 finite values .*, got \[0.0, 1e\+300\]$"),
        ([0.0, "fast"], [1.0], r"state: expected 2 finite values .*, got \[0.0, 'fast'\]"),
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


def test_the_loop_sleeps_what_the_policy_leaves_of_a_period(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    run(policy, lambda: [0.5, 1.0], sent.append, [1.0], steps=3, stop=None)
    assert len(sent) == 5 and sent[-1].any(), "one that holds its position gets no other command"


@pytest.mark.parametrize("stop", [[0.0, 0.0], [np.nan]])
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
