"""One fault in otherwise good logs is one finding, and it names the fault."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from toy_logs import Columns, toy_columns, write_logs

from astra_data.core.arrays import Floats
from astra_data.dataset.checkup import (
    Checkup,
    Clock,
    Finding,
    check_up,
    commands,
    continuity,
    endings,
    held_steps,
    is_angle,
    is_clock,
    longest_rests,
    repeated,
    repeats,
    shift,
    torn_steps,
)
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE, Array, Column, Episode


def test_good_logs_have_no_findings(tmp_path: Path) -> None:
    checkup = check_up(write_logs(tmp_path / "logs"))
    assert checkup == Checkup(
        (
            "endings: 30 after 100 steps, the longest (a time limit)",
            "commands: held 0.5 s (median), 0.5 s (95 %); steps at the edge of the range: v 0.7 %, w 0.7 %",
            "rate: 20 Hz declared, 20 Hz by time; gaps within episodes: 0, jitter 0.0 % of a period",
        ),
        (),
    )


def missed(uid: int, columns: Columns) -> None:
    if uid in (3, 4):
        columns["time"][50:] += 10**8


def slow(uid: int, columns: Columns) -> None:
    columns["time"] = columns["time"] * 2


def jittery(uid: int, columns: Columns) -> None:
    columns["time"][1::2] += 12 * 10**6


def standing(uid: int, columns: Columns) -> None:
    if uid == 9:
        columns["time"][50:] -= 10**9 // 20


def dead(uid: int, columns: Columns) -> None:
    for name in (STATE, NEXT_STATE):
        columns[name][:, 1] = 0.5


def stuck(uid: int, columns: Columns) -> Columns | None:
    if uid in (5, 6):
        columns[STATE][30:, 2] = columns[NEXT_STATE][29:, 2] = columns[STATE][30, 2]
    return {name: values[-9:] for name, values in columns.items()} if uid == 6 else None  # which tells nothing


def unused(uid: int, columns: Columns) -> None:
    columns[ACTION][:, 1] = 0.0


def copied(uid: int, columns: Columns) -> Columns | None:
    return toy_columns(2) if uid in (11, 12) else None


def torn(uid: int, columns: Columns) -> None:
    if uid == 2:
        columns[NEXT_STATE][60, 0] += 0.001


def saturated(uid: int, columns: Columns) -> None:
    columns[ACTION][:, 1] = np.clip(2 * columns[ACTION][:, 1], -1, 1)


def in_degrees(uid: int, columns: Columns) -> None:
    for name in (STATE, NEXT_STATE):
        columns[name][:, 2] *= np.float32(180 / np.pi)


def failing(uid: int, columns: Columns) -> None:
    if uid < 9:
        columns["next.terminated"] = columns["next.done"]
        columns["next.truncated"] = columns["next.truncated"] & False


FAULTS: list[tuple[Callable[[int, Columns], Columns | None], str, tuple[int, ...], str, str]] = [
    (missed, "warning", (3, 4), "steps of over 1.5 periods: 2, the longest 0.15 s", "gap_s = 0.075"),
    (slow, "warning", (), "time runs at 10 Hz, but 20 Hz is declared", "correct `fps`"),
    (jittery, "note", (), "5 % of the steps are off by 24 %", "resample the recording to 20 Hz"),
    (standing, "warning", (9,), "time stands still or goes back", "filter walks --without 9"),
    (dead, "note", (), "constant in all steps: y of observation.state", "check the log"),
    (stuck, "warning", (5,), "others move: yaw of observation.state", "filter walks --without 5"),
    (unused, "note", (), "constant in all steps: w of action", "its effect cannot be learned"),
    (copied, "warning", (11, 12), "11 has the states and actions of 2", "--without 11 --without 12"),
    (torn, "warning", (2,), "not the state of the next row: 1 of 2970", "rows are missing"),
    (in_degrees, "warning", (), "yaw of observation.state: up to", "degrees, set `scale` to 0.0174533"),
    (saturated, "note", (), "at the edge of their range in up to", "record gentler commands"),
    (failing, "note", tuple(range(9)), "9 failures, which is little", "--behavior stress"),
]


@pytest.mark.parametrize("case", FAULTS, ids=lambda case: case[0].__name__)
def test_a_planted_fault_is_the_one_finding(
    tmp_path: Path, case: tuple[Callable[[int, Columns], Columns | None], str, tuple[int, ...], str, str]
) -> None:
    alter, severity, episodes, what, advice = case
    found = check_up(write_logs(tmp_path / "logs", alter), "walks").findings
    assert len(found) == 1, found
    assert (found[0].severity, found[0].episodes) == (severity, episodes) and what in found[0].what
    assert advice in found[0].advice


def test_warnings_come_first(tmp_path: Path) -> None:
    def two(uid: int, columns: Columns) -> None:
        saturated(uid, columns)
        missed(uid, columns)

    checkup = check_up(write_logs(tmp_path / "logs", two))
    assert [finding.severity for finding in checkup.findings] == ["warning", "note"]


def test_angles_are_known_by_their_names() -> None:
    assert all(map(is_angle, ("theta", "Base.Yaw", "heading_deg", "joint1.pos")))
    assert not any(map(is_angle, ("y", "theta.vel", "yaw_rate", "cos_yaw_dot")))


@pytest.mark.parametrize("shape", [(6,), (6, 2)])
def test_a_step_leads_to_the_row_after_it(shape: tuple[int, ...]) -> None:
    walk = np.random.default_rng(0).normal(size=(7, *shape[1:])).astype(np.float32)
    state, arrived = walk[:-1], walk[1:].copy()
    arrived[-1] = 9.0  # whatever is after the last row
    off = arrived.copy()
    off[1] = np.nextafter(off[1], np.float32(100))
    episodes = [Episode(uid, {STATE: state[:n], NEXT_STATE: arrived[:n]}) for uid, n in ((0, 6), (1, 1))]
    counts = {one.uid: torn_steps(one) for one in episodes}
    assert not continuity(counts)
    (found,) = continuity(counts | {4: torn_steps(Episode(4, {STATE: state, NEXT_STATE: off}))})
    assert found.severity == "warning" and found.episodes == (4,)
    assert found.what == "steps whose next.observation.state is not the state of the next row: 1 of 10"


WALK = np.cumsum(np.random.default_rng(0).normal(size=(400, 2)), axis=0)


@pytest.mark.parametrize(
    ("state", "found"),
    [
        (np.repeat(WALK, 2, axis=0), True),
        (WALK, False),
        (np.repeat(WALK, np.where(np.arange(400) % 50, 1, 60), axis=0), False),  # rests
        (np.zeros((400, 2)), False),
    ],
)
def test_rows_that_were_written_twice_are_found(state: Array, found: bool) -> None:
    assert bool(repeats([repeated(state[:200]), repeated(state[200:])])) is found


def shifted(state: Floats, action: Floats) -> list[Finding]:
    halves = (slice(0, len(state) // 2), slice(len(state) // 2, None))
    return shift([(state[half].astype(np.float32), action[half].astype(np.float32)) for half in halves])


def walk(actions: Floats, delay: int = 0) -> Floats:
    """Return states (T, 2) that each action of `delay` rows before moves."""
    moves = np.roll(actions, delay, axis=0)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(0.1 * moves, axis=0)[:-1]])


ACTIONS = np.random.default_rng(0).normal(size=(400, 2))


@pytest.mark.parametrize("off", [-3, -1, 1, 2])
def test_actions_of_other_rows_are_found(off: int) -> None:
    [finding] = shifted(walk(ACTIONS), np.roll(ACTIONS, off, axis=0))
    rows = f"{abs(off)} row{'s' if abs(off) > 1 else ''}"
    where = "later" if off > 0 else "earlier"
    assert finding.what.startswith(f"steps follow from the action {rows} {where}, which explains 100%")
    assert finding.severity == ("warning" if off > 0 else "note")


def feedback() -> tuple[Floats, Floats]:
    """Return states and actions of a robot that is steered back to 0, with noise in both."""
    rng = np.random.default_rng(1)
    states, actions = np.zeros((400, 2)), np.zeros((400, 2))
    for t in range(400):
        actions[t] = -states[t] + 0.1 * rng.normal(size=2)
        if t < 399:
            states[t + 1] = states[t] + 0.2 * actions[t] + 0.02 * rng.normal(size=2)
    return states, actions


@pytest.mark.parametrize(
    ("state", "action"),
    [
        (walk(ACTIONS), ACTIONS),
        (walk(ACTIONS) + 0.01 * np.random.default_rng(2).normal(size=(400, 2)), ACTIONS),
        (np.zeros((400, 2)), ACTIONS),
        (walk(np.repeat(ACTIONS[:40], 10, axis=0)), np.repeat(ACTIONS[:40], 10, axis=0)),
        (np.random.default_rng(3).normal(size=(400, 2)), ACTIONS),
        (walk(ACTIONS)[:30], np.roll(ACTIONS, 1, axis=0)[:30]),  # too few
        feedback(),
    ],
)
def test_actions_of_their_own_rows_are_not(state: Floats, action: Floats) -> None:
    assert shifted(state, action) == []


def test_every_way_to_end_is_counted() -> None:
    lengths, ended = np.array([9, 8, 50, 50, 30, 7]), np.array([1, 1, 0, 0, 0, 1], bool)
    line, (found,) = endings(range(6), lengths, ended, [True, False, False, None, False, None])
    assert line == (
        "1 in success, 1 in failure, 1 terminated, success unknown, 2 after 50 steps, the longest (a time limit), 1 cut"
    )
    assert found.episodes == (1,) and endings([0, 1], np.array([9, 12]), np.zeros(2, bool), None) == ("2 cut", [])
    line, findings = endings([0, 1], np.array([9, 9]), None, None)
    assert line.startswith("unknown") and not findings


@pytest.mark.parametrize(("longest", "found"), [(1, True), (2, False)])
def test_episodes_that_all_end_in_their_first_step_are_told(longest: int, found: bool) -> None:
    assert bool(endings([0, 1], np.array([1, longest]), None, [None, None])[1]) is found


@pytest.mark.parametrize(("failures", "found"), [(0, False), (1, True), (9, True), (10, False)])
def test_few_failures_are_told(failures: int, found: bool) -> None:
    lengths, ended = np.full(30, 9), np.arange(30) < failures
    findings = endings(range(30), lengths, ended, [False] * 30)[1]
    assert [finding.episodes for finding in findings] == ([tuple(range(failures))] if found else [])
    assert not endings(range(30), lengths, ended, None)[1]  # where success is unknown, failure is


def test_commands_are_held_as_long_as_all_of_them_stay() -> None:
    actions = np.array([[0, 0], [0, 0], [0, 0], [0, 1], [2, 1], [2, 1], [3, 3]], np.float32)
    assert held_steps(actions).tolist() == [3, 1, 2]  # the end cuts the last
    assert held_steps(np.ones((4, 2), np.float32)).tolist() == [4]
    assert held_steps(np.ones((1, 2), np.float32)).tolist() == [1]


def test_steps_at_either_edge_of_the_range_are_counted() -> None:
    linear = [np.linspace(-0.5, 0.5, 10), np.linspace(-0.8, 0.8, 8)]
    episodes = [*linear, np.array([-1.0, 1.0]), np.array([1.0] * 5 + [-1.0] * 2 + [0.0] * 3)]
    actions = [part[:, None] for part in episodes]
    line, found = commands(Column(ACTION), actions, np.array([[-1.0], [1.0]]), 10)
    assert line == "held 0.1 s (median), 0.5 s (95 %); steps at the edge of the range: action 30.0 %"
    assert "in up to 30 % of steps, action" in found[0].what


@pytest.mark.parametrize(("values", "found"), [(8, False), (9, True)])
def test_a_choice_of_a_few_commands_has_no_edge(values: int, found: bool) -> None:
    actions = np.array_split(np.tile(np.arange(values), 10)[:, None], 2)
    assert bool(commands(Column(ACTION), actions, np.array([[0], [values - 1]]), 10)[1]) == found


def test_the_longest_rest_is_counted_in_each_column() -> None:
    changes = np.array([[1, 0, 0], [0, 0, 1], [0, 0, 0], [1, 0, 0], [0, 0, 1]], bool)
    assert longest_rests(changes).tolist() == [2, 5, 2]


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
    assert [finding.episodes for finding in timed.findings("walks")] == [(1,)] * found


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


def test_times_that_float32_rounds_are_told_apart_from_rows_that_are_there_twice() -> None:
    found = []
    for began in (0.0, 1.7e9):
        stamps = Clock.of(Column("time"), 10)
        stamps.add(Episode(0, {"time": (began + np.array([0, 1, 1, *range(2, 20)]) / 10).astype(np.float32)}))
        found.append(stamps.findings("walks")[0].advice)
    assert found[0].startswith("look for duplicate rows") and found[1].startswith("store it as seconds since the start")
