from pathlib import Path

import numpy as np
import pytest
from fake_dataset import writer

from astra_data.core.errors import BadInputError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import (
    ACTION,
    DONE,
    GOAL,
    OUTCOME_COLUMNS,
    STATE,
    SUCCESS,
    TERMINATED,
    TRUNCATED,
    Column,
    Episode,
)
from astra_data.exchange.dataset_logs import logs_of

POSE = Column(STATE, size=2, names=("x", "Yaw.pos"), astra={"unit": ["m", ""]})
SPEED = Column(ACTION, size=1)
ENDS = ((False, False), (True, False), (True, True))
"""Terminated and success at the end of each episode."""


def recorded(root: Path, *columns: Column, fps: int = 20) -> Dataset:
    names = {column.name for column in columns}
    with writer(root, columns=columns, fps=fps) as out:
        for uid, (terminated, success) in enumerate(ENDS):
            steps = 4 + uid
            last = np.arange(steps) == steps - 1
            flags = {
                TERMINATED: last & terminated,
                SUCCESS: last & success,
                DONE: last,
                TRUNCATED: last & (not terminated),
            }
            values = {
                column.name: flags.get(column.name, np.zeros(steps, column.dtype)) for column in columns
            }
            values |= {STATE: uid + np.arange(2 * steps, dtype=np.float32).reshape(steps, 2)}
            values |= {ACTION: np.arange(steps, dtype=np.float32) - uid}
            out.add(Episode(uid, {name: values[name] for name in names}))
    return Dataset.open(root)


def test_states_commands_and_failures_are_fields_of_logs(tmp_path: Path) -> None:
    logs = logs_of(recorded(tmp_path / "data", POSE, SPEED, *OUTCOME_COLUMNS))
    assert [(field.short, field.unit) for field in logs.of("state")] == [("x", "m"), ("Yaw.pos", "1")]
    assert [(field.short, field.unit, field.scale) for field in logs.of("command")] == [("c0", "1", 1.0)]
    assert [len(values) for values in logs.values(logs.of("state"))] == [4, 5, 6]
    np.testing.assert_array_equal(logs.values(logs.of("state"))[1], 1 + np.arange(10).reshape(5, 2))
    np.testing.assert_array_equal(logs.values(logs.of("command"))[2][:, 0], np.arange(6) - 2)
    assert logs.failed == [False, True, False]
    assert [field.why for field in logs.of("failure")] == ["next.terminated, and no success: 1 of 3 episodes"]
    assert logs.of("goal") == ()
    assert (logs.rate, logs.uneven, logs.left_out) == (20, "", {})


def test_an_angle_without_a_unit_is_in_rad_where_it_may_be(tmp_path: Path) -> None:
    poses = Column(STATE, size=2, names=("yaw", "pitch"))  # up to 12 and to 13
    logs = logs_of(recorded(tmp_path / "data", poses, SPEED))
    assert [(field.short, field.unit) for field in logs.of("state")] == [("yaw", "rad"), ("pitch", "1")]
    assert logs.of("state")[0].why == "its column, an angle up to 12"


def test_without_outcomes_nothing_fails(tmp_path: Path) -> None:
    logs = logs_of(recorded(tmp_path / "data", POSE, SPEED, fps=7))
    assert logs.failed == [False, False, False] and logs.rate == 7
    assert not logs.of("failure")


def test_goals_are_fields_of_logs(tmp_path: Path) -> None:
    goals = Column(GOAL, size=2, names=("goal_x", "goal_y"), astra={"unit": ["m", "m"]})
    data = tmp_path / "data"
    with writer(data, columns=(POSE, SPEED, goals)) as out:
        values = np.arange(6, dtype=np.float32).reshape(3, 2)
        out.add(Episode(0, {STATE: values, ACTION: values[:, 0], GOAL: 2 * values}))
    logs = logs_of(Dataset.open(data))
    assert [(field.short, field.unit) for field in logs.of("goal")] == [("goal_x", "m"), ("goal_y", "m")]
    np.testing.assert_array_equal(logs.values(logs.of("goal"))[0], 2 * values)


@pytest.mark.parametrize(
    ("name", "unit", "turn", "wrong"),
    [
        ("Base.heading", "deg", "rad/s", "observation.state Base.heading in deg"),
        ("yaw", "rad", "deg/s", "action w in deg/s"),
        ("yaw", "deg", "deg/s", "observation.state yaw in deg, action w in deg/s"),
    ],
)
def test_a_heading_in_degrees_is_refused_since_nothing_scales_it(
    name: str, unit: str, turn: str, wrong: str, tmp_path: Path
) -> None:
    pose = Column(STATE, size=2, names=("x", name), astra={"unit": ["m", unit]})
    command = Column(ACTION, names=("w",), astra={"unit": [turn]})
    data = recorded(tmp_path / "data", pose, command, *OUTCOME_COLUMNS)
    with pytest.raises(BadInputError, match=f"fake@data-1.0.0 has {wrong}: expected rad and rad/s"):
        logs_of(data)


@pytest.mark.parametrize("unit", ["", "1", "rad"])
def test_a_heading_without_a_unit_that_is_too_large_for_rad_is_refused(tmp_path: Path, unit: str) -> None:
    pose = Column(STATE, size=2, names=("pos_0", "base.yaw"), astra={"unit": ["m", unit]})  # up to 13
    data = recorded(tmp_path / "data", pose, Column(ACTION, names=("c0",)))
    if unit == "rad":
        assert logs_of(data).of("state")[1].unit == "rad"
        return
    with pytest.raises(BadInputError, match=r"has observation.state base.yaw up to 13 without a unit: exp"):
        logs_of(data)


def test_joints_may_be_in_degrees(tmp_path: Path) -> None:
    joints = Column(STATE, size=2, names=("shoulder", "elbow"), astra={"unit": ["deg", "deg"]})
    command = Column(ACTION, names=("elbow",), astra={"unit": ["deg/s"]})
    logs = logs_of(recorded(tmp_path / "data", joints, command, *OUTCOME_COLUMNS))
    assert [field.unit for field in logs.fields] == ["s", "deg", "deg", "deg/s", "1"]
