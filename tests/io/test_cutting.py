"""What the cutter makes of rows whose outcome is known."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from astra_data.dataset.columns import ACTION, DONE, NEXT_STATE, REWARD, STATE, SUCCESS, TERMINATED, TRUNCATED, Array
from astra_data.dataset.inspection import Endings
from astra_data.io.cutting import Cutter
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import Block


def cutter(**changes: Any) -> Cutter:
    settings: dict[str, Any] = {
        "name": "log",
        "task": "walk",
        "fps": 10,
        "columns": {STATE: {"fields": ("x",)}, ACTION: {"fields": ("a",)}},
    }
    return Cutter(ImportMapping.model_validate(settings | changes))


def cut(cutter: Cutter, **fields: ArrayLike) -> list[dict[str, Array]]:
    """Cut one file with an `x` and an `a` that tells the row."""
    arrays = {name: np.asarray(values) for name, values in fields.items()}
    arrays.setdefault("a", np.arange(len(arrays["x"])))
    assert not list(cutter.feed(Block(arrays, "log"), is_apart=True))
    return [columns for columns, _ in cutter.cut()]


def rows(episodes: list[dict[str, Array]]) -> list[list[int]]:
    return [episode[ACTION].astype(int).tolist() for episode in episodes]


def test_the_next_state_is_the_next_row() -> None:
    (episode,) = cut(cutter(), x=[0.0, 1, 4, 9])
    assert episode[STATE].tolist() == [0, 1, 4] and episode[NEXT_STATE].tolist() == [1, 4, 9]
    assert episode[ACTION].tolist() == [0, 1, 2]
    assert episode[TRUNCATED].tolist() == episode[DONE].tolist() == [False, False, True]
    assert not episode[TERMINATED].any()


def test_a_flag_ends_an_episode() -> None:
    cutting = cutter(split={"ends": ("end",)})
    episodes = cut(cutting, x=np.zeros(9), end=[0, 0, 0, 1, 0, 0, 1, 1, 0])
    assert rows(episodes) == [[0, 1, 2], [4, 5]] and cutting.tally.split_points == {"end": 3}
    assert cutting.tally.last_rows == 4  # row 7 and row 8 are alone: without a next state nothing is left of them


def test_columns_that_are_flags_end_episodes_too() -> None:
    fell = {"fields": ("alive",), "scale": (-1,), "offset": (1,)}
    columns: dict[str, Any] = {name: {"fields": ("a",)} for name in (ACTION, REWARD)}
    columns |= {STATE: {"fields": ("x",)}, TERMINATED: fell, TRUNCATED: {"fields": ("late",)}}
    cutting = cutter(columns=columns, terminal="stand_still")
    episodes = cut(cutting, x=np.arange(8) * 2, alive=[1, 1, 0, 1, 1, 1, 1, 1], late=[0, 0, 0, 0, 0, 1, 0, 0])
    # Of row 2 the next state is its own, since it is terminal; of rows 5 and 7 nobody recorded one.
    assert rows(episodes) == [[0, 1, 2], [3, 4], [6]]
    assert [episode[NEXT_STATE].tolist() for episode in episodes] == [[2, 4, 4], [8, 10], [14]]
    assert [episode[TERMINATED].tolist() for episode in episodes] == [[False, False, True], [False] * 2, [False]]
    assert [episode[TRUNCATED].tolist() for episode in episodes] == [[False] * 3, [False, True], [True]]
    assert cutting.tally.split_points == {"end": 2}
    assert (cutting.tally.last_rows, cutting.tally.last_reward) == (2, 12)
    assert cutting.tally.endings == Endings(terminated=1, cut_off=2, made_up=1)


def test_a_terminated_row_without_a_next_state_hands_its_outcome_to_the_step_before() -> None:
    columns = {STATE: {"fields": ("x",)}, ACTION: {"fields": ("a",)}, REWARD: {"fields": ("a",)}}
    columns |= {TERMINATED: {"fields": ("over",)}, SUCCESS: {"fields": ("there",)}}
    cutting = cutter(columns=columns)
    over, there = [0, 0, 1, 0, 1, 1, 0, 0], [0, 0, 1, 1, 0, 0, 0, 1]
    episodes = cut(cutting, x=np.arange(8) * 2, over=over, there=there)
    # Row 3 leads to no success; row 5 is alone; row 7 is cut off, and step 6 leads to where it succeeds.
    assert rows(episodes) == [[0, 1], [3], [6]]
    assert [episode[REWARD].tolist() for episode in episodes] == [[0, 1 + 2], [3 + 4], [6]]
    assert [episode[NEXT_STATE].tolist() for episode in episodes] == [[2, 4], [8], [14]]
    assert [episode[TERMINATED].tolist() for episode in episodes] == [[False, True], [True], [False]]
    assert [episode[SUCCESS].tolist() for episode in episodes] == [[False, True], [False], [True]]
    assert [episode[TRUNCATED].tolist() for episode in episodes] == [[False, False], [False], [True]]
    assert cutting.tally.endings == Endings(terminated=2, cut_off=1)
    tally = cutting.tally
    assert (tally.last_rows, tally.last_terminated, tally.last_reward) == (3, 2, 7) and tally.rows_after_end == 1


@pytest.mark.parametrize("terminal", ["drop", "stand_still"])
def test_a_log_that_goes_on_after_the_end_makes_no_episodes_of_it(terminal: str) -> None:
    columns = {STATE: {"fields": ("x",)}, ACTION: {"fields": ("a",)}, TERMINATED: {"fields": ("over",)}}
    cutting = cutter(columns=columns, terminal=terminal)
    episodes = cut(cutting, x=np.arange(9.0), over=[0, 0, 1, 1, 1, 1, 0, 0, 1])
    wanted = [[0, 1], [6, 7]] if terminal == "drop" else [[0, 1, 2], [6, 7, 8]]
    assert rows(episodes) == wanted and [bool(episode[TERMINATED][-1]) for episode in episodes] == [True, True]
    assert cutting.tally.rows_after_end == 3


def test_episodes_of_one_step_with_a_next_state_are_kept() -> None:
    columns = {name: {"fields": (field,)} for name, field in ((STATE, "x"), (NEXT_STATE, "y"), (ACTION, "a"))}
    cutting = cutter(columns=columns | {TERMINATED: {"fields": ("over",)}}, min_steps=1)
    episodes = cut(cutting, x=np.arange(4.0), y=np.arange(4.0) + 1, over=[0, 1, 1, 1])
    assert rows(episodes) == [[0, 1], [2], [3]] and cutting.tally.rows_after_end == 0


def test_gaps_and_steps_back_in_time_begin_episodes() -> None:
    cutting = cutter(time="t", split={"gap_s": 0.5})
    episodes = cut(cutting, x=np.zeros(8), t=[0, 0.1, 0.2, 1.0, 1.1, 0.3, 0.4, 0.5])
    assert rows(episodes) == [[0, 1], [3], [5, 6]] and cutting.tally.split_points == {"gap": 1, "back": 1}
    cutting.check()


def test_gaps_are_measured_between_the_rows_that_are_kept() -> None:
    """Over a row without a state too: no step from there to there is longer than 0.5 s."""
    nan, split = np.nan, {"gap_s": 0.5}
    x, t = [0, 0, nan, nan, 0, 0, 0, 0], [0, 0.1, 0.4, 0.7, 1.0, 1.1, 1.2, 1.3]
    cutting = cutter(time="t", split=split, not_finite="drop")
    assert rows(cut(cutting, x=x, t=t)) == [[0], [4, 5, 6]] and cutting.tally.split_points == {"gap": 1}
    cutting.check()
    alone = [0, nan, nan, 0.0]
    assert rows(cut(cutter(time="t", split=split, not_finite="drop"), x=alone, t=t[:4])) == []
    small = cutter(time="t", split={"gap_s": 0.9}, not_finite="drop")
    assert rows(cut(small, x=x, t=t)) == [[0, 1, 4, 5, 6]]


def test_a_rate_is_that_of_the_rows_that_are_kept() -> None:
    cutting = cutter(time="t", not_finite="drop")
    cut(cutting, x=np.where(np.arange(60) % 2, np.nan, 1.0), t=np.arange(60) / 20)
    cutting.check()
    assert cutting.tally.clock.startswith("10 Hz declared, 10 Hz by t")


@pytest.mark.parametrize(
    "split", [{"field": "e"}, {"ends": ("f",)}, {"jump": {"column": STATE, "values": (0,), "above": 0.5}}]
)
def test_no_time_passes_between_episodes(split: dict[str, Any]) -> None:
    cutting, number = cutter(time="t", split=split), np.arange(20) // 5
    cut(cutting, x=number, e=number, f=np.arange(20) % 5 == 4, t=np.arange(20) / 10 + 3 * number)
    cutting.check()
    assert cutting.tally.clock == "10 Hz declared, 10 Hz by t; gaps within episodes: 0, jitter 0.0 % of a period"


def timed(*files: Array, names: Sequence[str] = ()) -> Cutter:
    """Return a cutter that has read a file of each of these times."""
    cutting = cutter(time="t")
    for number, times in enumerate(files):
        values = {"x": np.zeros(len(times)), "a": np.zeros(len(times)), "t": times}
        origin = names[number] if names else f"{number}.csv"
        list(cutting.feed(Block(values, origin), is_apart=True))
    list(cutting.cut())
    return cutting


def test_files_of_a_few_rows_tell_no_rate() -> None:
    cutting = timed(np.arange(20) / 5, np.arange(21) / 5, np.arange(1000) / 10)
    cutting.check()
    assert cutting.tally.notes == ["1.csv: 5 Hz, 10 Hz declared"]


def test_files_of_other_rates_among_many_are_named() -> None:
    good = {f"{number}.csv": rate for number, rate in enumerate(np.linspace(9.2, 10.8, 30))}
    rates = {"fast.csv": 20.0, **good, "slow.csv": 5.0}
    cutting = timed(*(np.arange(50) / rate for rate in rates.values()), names=[*rates])
    cutting.check()
    assert cutting.tally.notes == ["fast.csv: 20 Hz, 10 Hz declared", "slow.csv: 5 Hz, 10 Hz declared"]


def test_episodes_of_other_rates_are_named_where_a_format_has_its_own() -> None:
    cutting = cutter(time="t")
    for number, rate in enumerate([10.0] * 20 + [5.0]):
        values = {"x": np.zeros(50), "a": np.zeros(50), "t": np.arange(50) / rate}
        list(cutting.feed(Block(values, f"demo_{number}", starts=True), is_apart=number == 0))
    list(cutting.cut())
    cutting.check()
    assert cutting.tally.notes == ["demo_20: 5 Hz, 10 Hz declared"]


def test_jumps_are_longer_than_their_bound() -> None:
    position = {"fields": ("x",), "scale": (0.125,)}
    cutting = cutter(
        columns={STATE: position, ACTION: {"fields": ("a",)}},
        split={"jump": {"column": STATE, "values": (0, 1), "above": 0.5}},
    )
    # 0.5 m, then 0.53 m in both directions together, and 1,249 in a value that does not count.
    x = np.array([[0, 0, 0], [4, 0, 0], [4, 0, 9], [7, 3, 9], [7, 3, 1e4]])
    assert rows(cut(cutting, x=x)) == [[0, 1], [3]] and cutting.tally.split_points == {"jump": 1}


def test_a_whole_turn_of_a_heading_is_no_jump() -> None:
    """By its role or its unit: 3.1 to -3.1 rad is a step of 0.08, and 359 to 1 degrees one of 2."""
    heading = {"fields": ("x",), "take": (0,), "role": ("heading",)}
    pan = {"fields": ("x",), "take": (1,), "unit": ("deg",)}
    x = np.array([[3.1, 0], [-3.1, 359], [-3.0, 1], [-2.0, 1], [-2.0, 181]])
    for column, above, expected in (("yaw", 0.5, [[0, 1], [3]]), ("pan", 3.0, [[0, 1, 2]])):
        columns = {STATE: {"fields": ("x",)}, ACTION: {"fields": ("a",)}, "yaw": heading, "pan": pan}
        cutting = cutter(columns=columns, split={"jump": {"column": column, "values": (0,), "above": above}})
        assert rows(cut(cutting, x=x)) == expected


@pytest.mark.parametrize(
    ("not_finite", "expected", "points"), [("drop", [[0, 3, 4]], {}), ("split", [[3, 4]], {"rejected": 1})]
)
def test_rejected_rows(not_finite: str, expected: list[list[int]], points: dict[str, int]) -> None:
    cutting = cutter(not_finite=not_finite)
    episodes = cut(cutting, x=[0, np.nan, np.inf, 3, 4, 5, 1e300])
    assert rows(episodes) == expected and cutting.tally.rejected_rows == 3
    assert cutting.tally.faults == "x in 3 rows, first log row 1" and cutting.tally.split_points == points


def test_a_rejected_row_that_ends_its_episode_is_no_gap_and_changes_no_rate() -> None:
    cutting = cutter(time="t", not_finite="split", split={"gap_s": 0.15})
    x = np.where(np.arange(60) % 3 == 2, np.nan, 0.0)
    episodes = cut(cutting, x=x, t=np.arange(60) / 10)
    assert rows(episodes) == [[first] for first in range(0, 60, 3)] and cutting.tally.split_points == {"rejected": 19}
    cutting.check()


def test_short_episodes_are_left_out_and_counted() -> None:
    cutting = cutter(split={"field": "k"}, min_steps=2)
    assert rows(cut(cutting, x=np.zeros(6), k=[0, 0, 1, 1, 1, 1])) == [[2, 3, 4]] and cutting.tally.short_rows == 1


def test_a_success_in_the_last_row_is_that_of_the_step_that_leads_to_it() -> None:
    columns = {STATE: {"fields": ("x",)}, ACTION: {"fields": ("a",)}, SUCCESS: {"fields": ("there",)}}
    cutting = cutter(columns=columns, split={"field": "k"})
    there = [0, 1, 0, 0, 0, 1, 1, 0, 0]
    episodes = cut(cutting, x=np.arange(9.0), there=there, k=[0, 0, 0, 1, 1, 1, 2, 2, 2])
    assert [episode[SUCCESS].tolist() for episode in episodes] == [[False, True], [False, True], [True, False]]


@pytest.mark.parametrize("not_finite", ["drop", "split"])
def test_a_failure_whose_row_is_rejected_is_that_of_the_last_row(not_finite: str) -> None:
    flags = {name: {"fields": (field,)} for name, field in ((TERMINATED, "fell"), (SUCCESS, "won"))}
    columns = {STATE: {"fields": ("x",)}, NEXT_STATE: {"fields": ("x",)}, ACTION: {"fields": ("a",)}}
    cutting = cutter(columns=columns | flags, not_finite=not_finite)
    nan, fell = float("nan"), [0, 0, 1, 0, 0, 0, 1, 0]
    episodes = cut(cutting, x=[0, 1, nan, 3, 4, nan, nan, 7], fell=fell, won=fell)
    assert rows(episodes) == [[0, 1], [3, 4], [7]]
    for name in (TERMINATED, SUCCESS):
        assert [episode[name].tolist() for episode in episodes] == [[False, True], [False, True], [False]]


def test_rows_without_a_value_of_the_field_are_one_episode_as_empty_cells_are() -> None:
    field = [1.0, 1.0, np.nan, np.nan, np.nan, 2.0, 2.0]
    made = cutter(split={"field": "trial"})
    assert rows(cut(made, x=np.arange(7), trial=field)) == [[0], [2, 3], [5]]
    assert made.tally.split_points == {"field": 2}


def test_columns_may_have_any_names() -> None:
    """Also those of what decides where rows are cut."""
    names = ("time", "row", "part", "finite", "torn", "field")
    columns = {name: {"fields": ("x",)} for name in (STATE, ACTION, *names)}
    cutting = cutter(columns=columns, time="t", split={"field": "k"})
    x = np.arange(60.0)[::-1]
    episodes = cut(cutting, x=x, t=np.arange(60) / 10, k=np.arange(60) // 30)
    for name in names:
        for episode, first in zip(episodes, (0, 30), strict=True):
            np.testing.assert_array_equal(episode[name], x[first : first + 29])
    cutting.check()
