"""Fields become columns: order of the operations, types, and what is refused."""

from typing import Any

import numpy as np
import pytest

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import DONE, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED, Array, Column
from astra_data.io import cutting
from astra_data.io.cutting import Cutter, Rounding, column_of
from astra_data.io.mapping import ColumnMapping, ImportMapping
from astra_data.io.recording import Block

NAN = np.nan


def converter(columns: dict[str, dict[str, Any]], **more: Any) -> Cutter:
    specs = {name: ColumnMapping.model_validate(spec) for name, spec in columns.items()}
    return Cutter(ImportMapping(name="n", task="t", fps=10, columns=specs, **more))


def convert(spec: dict[str, Any], values: list[Any], name: str = "c") -> tuple[Array, list[bool]]:
    """Return column `name` of one field with `values`, and which rows are finite."""
    columns, bad = converter({name: {"fields": ("f",), **spec}}).convert(Block({"f": np.array(values)}, "log"))
    return columns[name], [not any(mask[row] for mask in bad.values()) for row in range(len(values))]


def test_take_scale_offset_and_clip_follow_each_other() -> None:
    spec = {"take": (2, 0), "scale": (2.0, 10.0), "offset": (1.0, -1.0), "clip": (-5.0, 20.0)}
    values, finite = convert(spec, [[1, 7, 3], [4, 7, 100], [-9, 7, 0]])
    # (3 · 2 + 1, 1 · 10 - 1), (201 cut to 20, 39 cut to 20), (1, -91 cut to -5)
    assert values.tolist() == [[7, 9], [20, 20], [1, -5]] and values.dtype == np.float32 and finite == [True] * 3


def test_recorded_next_states_are_described_as_the_states_unless_the_mapping_says_more() -> None:
    state = {"fields": ("f",), "names": ("x", "v"), "unit": ("m", "m/s"), "role": ("invariant",)}
    block = Block({"f": np.ones((2, 2))}, "log")
    for more, names, unit in (({}, ("x", "v"), ["m", "m/s"]), ({"unit": ("mm",)}, ("x", "v"), ["mm", "mm"])):
        made = converter({STATE: state, NEXT_STATE: {"fields": ("f",), **more}})
        made.convert(block)
        found = {column.name: column for column in made.columns}[NEXT_STATE]
        assert (found.names, found.astra) == (names, {"unit": unit, "role": ["invariant"] * 2})
        assert found.meaning == "the state, one step later"


def test_what_is_not_finite_is_not_clipped_but_rejected() -> None:
    values, finite = convert({"clip": (-1.0, 1.0)}, [5.0, NAN, np.inf, -0.5])
    assert finite == [True, False, False, True] and values[[0, 3]].tolist() == [1, -0.5]


def test_rows_are_rejected_where_time_or_an_end_is_not_finite() -> None:
    made = converter({"c": {"fields": ("f",)}}, time="t", split={"ends": ("e",)})
    fields = {"f": np.zeros(4), "t": np.array([0, NAN, 2, 3]), "e": np.array([0, 0, np.inf, 0])}
    _, bad = made.convert(Block(fields, "log"))
    assert {name: mask.tolist() for name, mask in bad.items()} == {
        "t": [False, True, False, False],
        "e": [False, False, True, False],
    }


@pytest.mark.parametrize(
    ("spec", "values", "told"),
    [
        ({"dtype": "bool"}, [0, 1, 2], "columns.c: expected true and false, or 1 and 0"),
        ({"dtype": "int64"}, [1.0, 1.5], "columns.c: expected whole numbers"),
        ({"dtype": "int64"}, np.array([2**63], np.uint64), r"columns.c: expected whole numbers below 2\^63"),
        ({}, [2**53 + 1], r"columns.c: integers beyond 2\^53 do not fit float32; set dtype = .int64"),
        ({}, [-(2**53) - 1], r"columns.c: integers beyond 2\^53 do not fit float32; set dtype = .int64"),
        ({"take": (2,)}, [[1, 2]], r"columns.c: take \[2\]: f hold 2 values, counted from 0"),
        ({"scale": (1.0, 2.0, 3.0)}, [[1, 2]], "columns.c: scale has 3 numbers for 2 values"),
        ({"offset": (1.0, 2.0)}, [1], "columns.c: offset has 2 numbers for 1 values"),
        ({}, ["a"], "field 'f': expected numbers, got text$"),
        ({}, np.array([1, None]), "field 'f': expected numbers, got values that are not numbers, such as missing ones"),
        ({}, np.zeros((2, 0)), r"field 'f' has no values, its shape is \(2, 0\)"),
    ],
)
def test_values_that_do_not_fit_are_refused(spec: dict[str, Any], values: Any, told: str) -> None:
    with pytest.raises(BadInputError, match=f"^log: {told}"):
        convert(spec, values)


def test_sizes_that_contradict_each_other_are_all_listed() -> None:
    columns = {
        STATE: {"fields": ("two",)},
        NEXT_STATE: {"fields": ("three",)},
        REWARD: {"fields": ("two",)},
        TERMINATED: {"fields": ("flags",)},
    }
    jump = {"jump": {"column": STATE, "values": (0, 2), "above": 1.0}}
    fields = {"two": np.zeros((1, 2)), "three": np.zeros((1, 3)), "flags": np.zeros((1, 2))}
    with pytest.raises(BadInputError) as caught:
        converter(columns, split=jump).convert(Block(fields, "log"))
    for fault in (
        f"{NEXT_STATE} has 3 values, {STATE} 2",
        f"{REWARD}: 2 values, expected 1",
        f"{TERMINATED}: 2 values, expected 1",
        f"split.jump.values [0, 2]: {STATE} has 2 values, counted from 0",
    ):
        assert fault in str(caught.value)


def test_next_states_and_ends_are_derived_where_they_are_left_out() -> None:
    made = converter({STATE: {"fields": ("f",), "names": ("x",), "unit": ("m",)}})
    made.convert(Block({"f": np.zeros(2)}, "log"))
    columns = {column.name: column for column in made.columns}
    assert list(columns) == [STATE, NEXT_STATE, TERMINATED, TRUNCATED, DONE]
    assert columns[NEXT_STATE].names == ("x",) and columns[NEXT_STATE].astra == {"unit": ["m"]}
    assert columns[NEXT_STATE].meaning == "the state, one step later"
    ending = converter({STATE: {"fields": ("f",)}, TERMINATED: {"fields": ("f",)}}, terminal="stand_still")
    ending.convert(Block({"f": np.zeros(2)}, "log"))
    assert "where an episode terminates" in next(c.meaning for c in ending.columns if c.name == NEXT_STATE)
    whole = converter({STATE: {"fields": ("f",)}, NEXT_STATE: {"fields": ("f",)}})
    whole.convert(Block({"f": np.zeros(2)}, "log"))
    assert [column.name for column in whole.columns][:2] == [STATE, NEXT_STATE] and len(whole.columns) == 5


def test_values_are_called_as_their_fields_are_unless_the_mapping_says() -> None:
    spec = ColumnMapping(fields=("x", "y"))
    assert column_of("c", spec, 2).names == ("x", "y")
    assert column_of("c", spec.model_copy(update={"names": ("east", "north")}), 2).names == ("east", "north")
    # A field of several values, or the values that are taken of it, has no name for each.
    assert column_of("c", spec, 3).names is None
    assert column_of("c", spec.model_copy(update={"take": (0, 2)}), 2).names is None
    assert column_of("c", ColumnMapping(fields=("reward",)), 1).names is None


def test_whole_numbers_are_exact_to_their_bounds() -> None:
    values, finite = convert({"dtype": "int64"}, np.array([200, 2**63 - 1], np.uint64))  # type: ignore[arg-type]
    assert (values.tolist(), finite) == ([200, 2**63 - 1], [True, True])
    for number in (2.0**53, -(2.0**53)):  # which 2^53 + 1 is rounded to
        with pytest.raises(BadInputError, match=r"c: numbers of 2\^53 or more came as floats"):
            convert({"dtype": "int64"}, [0.0, number])
    assert convert({"dtype": "int64"}, [2.0**53 - 1])[0].tolist() == [2**53 - 1]
    assert convert({}, [2**53, -(2**53)])[0].tolist() == [2**53, -(2**53)]


def rounding(spec: dict[str, Any], values: Array) -> list[str]:
    """Return what is said of the steps of a column of these `values`, converted in two blocks."""
    made = converter({"c": {"fields": ("f",), **spec}})
    for block in (values[: len(values) // 2], values[len(values) // 2 :]):
        made.convert(Block({"f": block}, "log"))
    made.check()
    return made.tally.notes


ROWS = np.arange(60)
WAVE = np.cumsum(np.sin(ROWS))


@pytest.mark.parametrize(
    ("values", "offset"),
    [
        (119.1624 + 2.2e-6 * WAVE, -119.1624),  # degrees of longitude, 0.25 m a step
        (4_429_530.0 + 0.63 * ROWS, -4_429_550.0),  # UTM, of which float32 holds steps of 0.5 and 1.0
        (65_000 + 0.01 * ROWS, -65_000.3),
        (-1.0 - 1e-7 * WAVE, 1.0),
    ],
)
def test_steps_that_float32_rounds_are_warned_of_with_the_offset_that_helps(values: Array, offset: float) -> None:
    both = np.stack([ROWS / 8, values], axis=1)
    [warning] = rounding({"scale": (2.0,), "offset": (3.0, 0.0), "names": ("t", "x")}, both / 2)
    assert warning.startswith("columns.c: float32 holds x (up to")
    found = [float(number) for number in warning.rpartition("[")[2].rstrip("]").split(", ")]
    assert found[0] == 3.0 and found[1] == pytest.approx(offset, abs=float(np.ptp(values)))
    assert rounding({"scale": (2.0,), "offset": tuple(found)}, both / 2) == []


@pytest.mark.parametrize(
    ("start", "step"),
    [(1_700_000_000_000, 100), (1.7e12, 1e2), (5.3e6, 0.02), (5.3e6, 0.3), (-4.2e6, 0.1), (1e5, 0.004)],
)
def test_large_numbers_most_of_whose_steps_are_lost_are_refused(start: float, step: float) -> None:
    """Times in ms since 1970, northings, and positions from the center of the Earth."""
    told = r"columns\.c: float32 holds entry 1 .* moves by .*: set offset = \[0"
    with pytest.raises(BadInputError, match=told):
        rounding({}, np.stack([ROWS, start + step * ROWS], axis=1))


@pytest.mark.parametrize(
    "values",
    [
        5.3e6 + 0.5 * ROWS,  # exact
        100_000 + ROWS,
        1e6 * ROWS,
        np.full(60, 1.7e12),
        3.0 + 1e-3 * WAVE,
        1.0 + 2.0**-52 * (ROWS % 2),  # the noise of a computation
        np.where(ROWS < 50, 100 + 1e-7 * WAVE, 100 + 0.1 * ROWS),  # stands still for most of the time
        (5.3e6 + 0.02 * ROWS).astype(np.float32),
        (1_700_000_000_000 + 100 * ROWS[:9]).astype(float),  # too few
    ],
)
def test_steps_that_float32_holds_are_not_warned_of(values: Array) -> None:
    assert rounding({}, values) == []


def told(*blocks: Array) -> tuple[str, bool] | None:
    """Return what is found of rounding in `blocks` of a value y."""
    found = Rounding(Column("position", size=1, names=("y",)))
    for block in blocks:
        found.add(block[:, None], block.astype(np.float32)[:, None])
    return found.found()


def test_steps_are_compared_with_those_that_float32_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = np.arange(11.0)  # ten of them are enough
    south = told(-4_429_530 - 0.63 * steps)
    assert south is not None and "y (up to 4.42954e+06) in steps of 0.5, but it moves by 0.63" in south[0]
    assert south[0].endswith("set offset = [4429533.0]") and told(-4_429_530 - 0.63 * steps[1:]) is None
    counted = told(2.0**24 + steps)
    assert counted is not None and not counted[1] and told(1e15 + steps) is not None
    assert told(2**63 + np.arange(11, dtype=np.uint64)) is not None
    tiny = 2.0**-32 * steps
    assert told(2.0**20 + 100 * tiny) is not None and told(2.0**20 + 10 * tiny) is None  # the noise of float64
    monkeypatch.setattr(cutting, "_MOST_SAMPLES", 20)
    assert told(np.full(11, 2.0**24), *[2.0**24 + 0.3 * steps] * 2) is not None
