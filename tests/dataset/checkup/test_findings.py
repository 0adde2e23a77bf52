import numpy as np
import pytest
from numpy.typing import ArrayLike

from astra_data.dataset.checkup.findings import Clock, is_clock
from astra_data.dataset.columns import Column, Episode

SECONDS = Column("time", astra={"unit": ["s"]})


def clock(*steps_s: ArrayLike, fps: int = 10) -> Clock:
    """Times in ms."""
    found = Clock.of(Column("time", "int64", astra={"unit": ["ms"]}), fps)
    for uid, steps in enumerate(steps_s):
        times = np.cumsum([0, *np.asarray(steps)]) * 1000
        found.add(Episode(uid, {"time": np.rint(times).astype(np.int64)}))
    return found


REGULAR = [0.1] * 100


@pytest.mark.parametrize(
    ("column", "is_one"),
    [
        (Column("time"), True),
        (Column("observation.stamp"), True),
        (Column("header_timestamp_ns", "int64"), True),
        (Column("lifetime"), False),
        (Column("time_to_goal"), False),
        (Column("time", size=2), False),
        (Column("timestamp"), False),  # the writer's own
        (Column("time", "bool"), False),
    ],
)
def test_clocks_are_known_by_their_name(column: Column, is_one: bool) -> None:
    assert is_clock(column) is is_one


@pytest.mark.parametrize(
    ("column", "per_second"),
    [
        (Column("time", "int64", astra={"unit": ["ns"]}), 10**9),
        (Column("time_us", "int64"), 10**6),
        (Column("time", "int64"), 1),
    ],
)
def test_times_have_units(column: Column, per_second: int) -> None:
    found = Clock.of(column, 2)
    found.add(Episode(0, {column.name: np.arange(50, dtype=np.int64) * per_second}))
    assert found.rates()[0] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("period_s", "found"), [(0.0955, False), (0.1, False), (0.105, False), (0.106, True), (0.095, True)]
)
def test_a_rate_that_is_off_by_over_a_twentieth_is_wrong(period_s: float, found: bool) -> None:
    timed = Clock.of(SECONDS, 10)
    timed.add(Episode(0, {"time": (np.arange(100) * period_s).astype(np.float32)}))
    assert ["is declared" in finding.what for finding in timed.findings("walks")] == [True] * found


@pytest.mark.parametrize(("step_s", "found"), [(0.149, False), (0.152, True)])
def test_a_step_of_over_one_and_a_half_periods_is_a_gap(step_s: float, found: bool) -> None:
    timed = clock(REGULAR, [*REGULAR, step_s], REGULAR)
    assert timed.rates()[1] == found
    findings = timed.findings("walks")
    assert [finding.episodes for finding in findings] == [(1,)] * found


def test_gaps_are_counted_where_the_declared_rate_is_wrong_too() -> None:
    timed = clock([*REGULAR, 0.3, 0.4], fps=100)
    assert timed.rates()[1] == 2
    wrong, gaps = timed.findings("walks")
    assert "at 10 Hz, but 100 Hz is declared" in wrong.what and "the longest 0.4 s" in gaps.what
    assert "gap_s = 0.15" in gaps.advice


@pytest.mark.parametrize(("step_s", "found"), [(0.01, False), (0.0, True), (-0.3, True)])
def test_time_must_go_on(step_s: float, found: bool) -> None:
    findings = clock(REGULAR, [*REGULAR, step_s]).findings("walks")
    assert [finding.episodes for finding in findings] == [(1,)] * found


def test_a_step_of_next_to_no_time_is_another_unit() -> None:
    """Seconds that are called microseconds."""
    timed = Clock.of(Column("Stamp_US"), 20)
    timed.add(Episode(0, {"Stamp_US": np.arange(50, dtype=np.float32) * 0.05}))
    (finding,) = timed.findings("walks")
    assert finding.what == "a step takes 1/1000 of a period or less, by Stamp_US"
    assert finding.advice.startswith("give its `unit`")
    assert str(timed) == "20 Hz declared, and a step takes 1/1000 of a period or less by Stamp_US"
    fast = Clock.of(Column("time", astra={"unit": ["ms"]}), 20)
    fast.add(Episode(0, {"time": np.arange(50, dtype=np.float32) * np.float32(0.1)}))
    assert "at 1e+04 Hz" in fast.findings("walks")[0].what


def test_time_that_never_goes_on_has_no_rate() -> None:
    timed = clock([0.0] * 20)
    assert str(timed) == "10 Hz declared; time does not increase in most steps"
    (finding,) = timed.findings("walks")
    assert finding.what == "time stands still or goes back between steps"
