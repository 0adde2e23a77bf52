from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import columns as names
from astra_data.dataset.columns import STATE, Array, Column
from astra_data.dataset.format import DEFAULT_COLUMNS
from astra_data.dataset.lerobot_recording import RECORDED_TASK, Rows, declared_columns, description_of, found_in
from astra_data.dataset.plain import PlainColumn, Run

STEPS = 4


def rows_and_run(more: Mapping[str, Array]) -> tuple[Rows, Run]:
    """Return one episode of 4 rows with a state, and the columns `more`."""
    columns = {
        names.STATE: np.arange(2.0 * STEPS).reshape(STEPS, 2),
        names.EPISODE_INDEX: np.full(STEPS, 7),
        names.TASK_INDEX: np.array([0, 1, 1, 0]),
        **more,
    }
    stored = {
        name: PlainColumn(name, values.dtype.name, 1 if values.ndim == 1 else values.shape[1])
        for name, values in columns.items()
    }
    return Rows(stored, 10), Run(Path("file"), 0, columns)


def values(name: str, dtype: str = "float32", size: int = 1, more: Mapping[str, Array] | None = None) -> Array:
    rows, run = rows_and_run(more or {})
    return rows.values([Column(name, dtype, size)], run, 3, 100, 9)[name]


def test_rows_are_numbered_anew() -> None:
    assert values(names.INDEX, "int64").tolist() == [100, 101, 102]
    assert values(names.EPISODE_INDEX, "int64").tolist() == [3, 3, 3]
    assert values(names.EPISODE_UID, "int64").tolist() == [9, 9, 9]
    assert values(names.TASK_INDEX, "int64").tolist() == [0, 0, 0]
    assert values(RECORDED_TASK, "int64").tolist() == [0, 1, 1]
    np.testing.assert_array_equal(values(names.TIMESTAMP), np.array([0, 0.1, 0.2], np.float32))


def test_recorded_next_states_keep_every_row() -> None:
    after = np.ones((STEPS, 2), np.float32)
    assert values(names.NEXT_STATE, size=2).tolist() == [[2, 3], [4, 5], [6, 7]]
    np.testing.assert_array_equal(values(names.NEXT_STATE, size=2, more={names.NEXT_STATE: after}), after)
    assert len(values(names.STATE, size=2, more={names.NEXT_STATE: after})) == STEPS


@pytest.mark.parametrize("has_next", [True, False])
def test_an_episode_that_is_cut_off_is_truncated_unless_it_terminated(has_next: bool) -> None:
    steps = STEPS if has_next else STEPS - 1
    more: dict[str, Array] = {names.TERMINATED: np.arange(STEPS) == STEPS - 1}
    more |= {names.NEXT_STATE: np.ones((STEPS, 2), np.float32)} if has_next else {}
    last = np.arange(steps) == steps - 1
    np.testing.assert_array_equal(values(names.TERMINATED, "bool", more=more), last)
    assert not values(names.TRUNCATED, "bool", more=more).any()
    np.testing.assert_array_equal(values(names.DONE, "bool", more=more), last)
    del more[names.TERMINATED]
    np.testing.assert_array_equal(values(names.TRUNCATED, "bool", more=more), last)
    more[names.TRUNCATED] = np.zeros(STEPS, bool)
    np.testing.assert_array_equal(values(names.TRUNCATED, "bool", more=more), last)
    np.testing.assert_array_equal(values(names.DONE, "bool", more=more), last)


def test_a_terminated_row_that_is_left_out_hands_its_flags_to_the_step_before() -> None:
    last = np.arange(STEPS) == STEPS - 1
    over: dict[str, Array] = {names.TERMINATED: last, names.SUCCESS: last}
    assert values(names.SUCCESS, "bool", more=over).tolist() == [False, False, True]
    assert values(names.TRUNCATED, "bool", more=over).tolist() == [False, False, False]
    failed = {names.TERMINATED: last, names.SUCCESS: np.array([False, False, True, False])}
    assert values(names.SUCCESS, "bool", more=failed).tolist() == [False, False, False]
    cut_off: dict[str, Array] = {names.TERMINATED: np.zeros(STEPS, bool), names.SUCCESS: last}
    assert values(names.SUCCESS, "bool", more=cut_off).tolist() == [False, False, False]
    assert values(names.SUCCESS, "bool", more={names.SUCCESS: last}).tolist() == [False, False, False]
    done = {names.DONE: last, names.SUCCESS: last}
    assert values(names.SUCCESS, "bool", more=done).tolist() == [False, False, True]
    assert values(names.SUCCESS, "bool", more=cut_off | done).tolist() == [False, False, True]
    assert values(names.TERMINATED, "bool", more=done).tolist() == [False, False, False]
    earlier = {names.DONE: last, names.SUCCESS: failed[names.SUCCESS]}
    assert values(names.SUCCESS, "bool", more=earlier).tolist() == [False, False, True]
    with_next = over | {names.NEXT_STATE: np.ones((STEPS, 2), np.float32)}
    assert values(names.SUCCESS, "bool", more=with_next).tolist() == [False, False, False, True]


def test_a_terminated_row_that_is_left_out_hands_its_reward_to_the_step_before() -> None:
    last = np.arange(STEPS) == STEPS - 1
    sparse: dict[str, Array] = {names.REWARD: 5.0 * last, names.TERMINATED: last}
    assert values(names.REWARD, more=sparse).tolist() == [0, 0, 5]
    rows, run = rows_and_run(dict(sparse))
    assert found_in(run, rows, {}, row=0, uid=9).lost_reward == 0.0
    cut_off = sparse | {names.TERMINATED: ~last & last}
    assert values(names.REWARD, more=cut_off).tolist() == [0, 0, 0]
    rows, run = rows_and_run(cut_off)
    assert found_in(run, rows, {}, row=0, uid=9).lost_reward == 5.0


def test_a_success_of_the_row_that_is_left_out_is_lost_unless_the_episode_is_over() -> None:
    last = np.arange(STEPS) == STEPS - 1
    for more, lost in (
        ({names.SUCCESS: last}, True),
        ({names.SUCCESS: last, names.TERMINATED: last}, False),
        ({names.SUCCESS: last, names.DONE: last}, False),
        ({names.SUCCESS: last, names.DONE: np.zeros(STEPS, bool)}, True),
        ({names.SUCCESS: np.ones(STEPS, bool)}, False),
        ({names.SUCCESS: last, names.NEXT_STATE: np.ones((STEPS, 2), np.float32)}, False),
        ({}, False),
    ):
        rows, run = rows_and_run(dict(more))
        found = found_in(run, rows, {}, row=0, uid=9)
        assert found.lost_success == lost == (not found.metadata.get("success", True))
    rows, run = rows_and_run({names.REWARD: np.arange(STEPS, dtype=np.float32)})
    assert found_in(run, rows, {}, row=0, uid=9).lost_reward == STEPS - 1
    rows, run = rows_and_run({names.REWARD: np.ones(STEPS), names.NEXT_STATE: np.ones((STEPS, 2))})
    assert found_in(run, rows, {}, row=0, uid=9).lost_reward == 0.0


def test_whole_numbers_that_int64_does_not_hold_are_refused() -> None:
    with pytest.raises(BadInputError, match=r"count: expected whole numbers below 2\^63"):
        values("count", "int64", more={"count": np.full(STEPS, 2**63, np.uint64)})


WHOLE = "expected a whole number of frames per second"
LACKING = "lacks the columns episode_index, frame_index, index, task_index, timestamp, which are LeRobot's own"
OWN = {column.name: column.feature() for column in DEFAULT_COLUMNS}


def declared(**features: Any) -> list[Column]:
    return declared_columns(Path("set"), {"fps": 10.0, "features": OWN | features})[1]


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        (["x", "y"], ("x", "y")),
        ({"motors": ["x", "y"]}, ("x", "y")),
        ({"motors": ["x"]}, None),
        ({"a": ["x", "y"], "b": []}, None),
        (["x", 1], None),
        (None, None),
    ],
)
def test_names_are_taken_where_there_is_one_per_value(labels: object, expected: tuple[str, ...] | None) -> None:
    feature = {"dtype": "float64", "shape": [2], "names": labels}
    assert declared(**{STATE: feature}) == [Column(STATE, "float32", 2, expected)]


def test_only_lists_of_numbers_are_columns() -> None:
    features = {
        "observation.images.top": {"dtype": "video", "shape": [8, 8, 3], "names": None},
        "text": {"dtype": "string", "shape": [1], "names": None},
        "grid": {"dtype": "float32", "shape": [2, 2], "names": None},
        "count": {"dtype": "uint8", "shape": [1], "names": None},
    }
    assert declared(**features) == [Column("count", "int64")]


@pytest.mark.parametrize(
    ("info", "faults"),
    [
        ({"fps": 10, "features": {}}, [LACKING]),
        ({"fps": 9.5, "features": OWN}, [f"has fps 9.5, {WHOLE}"]),
        ({"fps": 0.5, "features": OWN}, [f"has fps 0.5, {WHOLE}"]),
        ({"fps": 2**31, "features": OWN}, [f"has fps 2147483648, {WHOLE}"]),
        (
            {"fps": 10, "features": OWN | {"index": {"dtype": "float64", "shape": [2]}}},
            ["has no single number a step as index"],
        ),
        ({}, [LACKING, f"has fps None, {WHOLE}"]),
    ],
)
def test_without_lerobots_own_columns_or_a_whole_rate_nothing_is_known(info: dict[str, Any], faults: list[str]) -> None:
    with pytest.raises(CorruptDatasetError) as refused:
        declared_columns(Path("set"), info)
    assert str(refused.value) == f"set: meta/info.json {' and '.join(faults)}"


def test_a_folder_gives_a_valid_name() -> None:
    names = [description_of(Path(name), {}, "repair", {})["name"] for name in ("walks", "my set (2)", "-._")]
    assert names == ["walks", "my-set-2-", "repaired"]
