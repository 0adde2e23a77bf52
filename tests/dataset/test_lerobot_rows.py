from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from astra_data.dataset import columns as names
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.lerobot_rows import RECORDED_TASK, Rows, our_columns
from astra_data.dataset.plain import PlainColumn, Run

More = Mapping[str, Array] | None
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


def values(
    name: str, dtype: str = "float32", size: int = 1, more: Mapping[str, Array] | None = None
) -> Array:
    rows, run = rows_and_run(more or {})
    return rows.values(Column(name, dtype, size), run, 3, 100, 9)


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


def test_an_episode_that_ends_at_its_time_limit_too_keeps_both_flags() -> None:
    last = np.arange(STEPS) == STEPS - 1
    both: dict[str, Array] = {names.TERMINATED: last, names.TRUNCATED: last}
    with_next = both | {names.NEXT_STATE: np.ones((STEPS, 2), np.float32)}
    for name in (names.TERMINATED, names.TRUNCATED, names.DONE):
        np.testing.assert_array_equal(values(name, "bool", more=with_next), last)
    # The step before a row that is left out is terminated, and no longer cut off by the end of the rows.
    assert values(names.TERMINATED, "bool", more=both).tolist() == [False, False, True]
    assert values(names.TRUNCATED, "bool", more=both).tolist() == [False, False, False]
    earlier: dict[str, Array] = {names.TERMINATED: last, names.TRUNCATED: np.arange(STEPS) == STEPS - 2}
    assert values(names.TERMINATED, "bool", more=earlier).tolist() == [False, False, True]
    assert values(names.TRUNCATED, "bool", more=earlier).tolist() == [False, False, True]


def test_only_the_columns_that_are_needed_are_read() -> None:
    rows, _ = rows_and_run({names.FRAME_INDEX: np.arange(STEPS), "force": np.ones(STEPS)})

    def read(name: str) -> set[str]:
        return {column.name for column in rows.stored_for([name])} - {names.EPISODE_INDEX, names.FRAME_INDEX}

    assert read(names.NEXT_STATE) == read(names.STATE) == {names.STATE}
    assert read(RECORDED_TASK) == {names.TASK_INDEX}
    assert read(names.TIMESTAMP) == set()
    assert read("force") == {"force"}
    rows, _ = rows_and_run({names.TERMINATED: np.zeros(STEPS), names.SUCCESS: np.zeros(STEPS)})
    assert read(names.SUCCESS) == {names.SUCCESS, names.TERMINATED}
    rows, _ = rows_and_run({names.DONE: np.zeros(STEPS), names.SUCCESS: np.zeros(STEPS)})
    assert read(names.SUCCESS) == {names.SUCCESS, names.DONE}
    rows, _ = rows_and_run({names.TERMINATED: np.zeros(STEPS), names.TRUNCATED: np.zeros(STEPS)})
    assert read(names.TERMINATED) == read(names.DONE) == {names.TERMINATED, names.TRUNCATED}


def test_columns_of_ours_have_our_types() -> None:
    recorded = [Column(names.STATE, size=2), Column(names.ACTION, "int64"), Column(names.SUCCESS, "float32")]
    found = {column.name: column for column in our_columns(recorded, has_tasks=False)}
    assert (found[names.ACTION].dtype, found[names.SUCCESS].dtype) == ("float32", "bool")
    assert found[names.NEXT_STATE].meaning == "the state, one step later"
    assert RECORDED_TASK not in found
    assert RECORDED_TASK in {column.name for column in our_columns(recorded, has_tasks=True)}


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
        assert rows.lost_success(run) == lost
    rows, run = rows_and_run({names.REWARD: np.arange(STEPS, dtype=np.float32)})
    assert rows.lost_reward(run) == STEPS - 1
    rows, run = rows_and_run({names.REWARD: np.ones(STEPS), names.NEXT_STATE: np.ones((STEPS, 2))})
    assert rows.lost_reward(run) == 0.0
