"""What to know of whole logs before a simulator is grounded with them: ends, commands, the rate, and findings."""

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats, Ints, as_rows
from astra_data.core.naming import first_few
from astra_data.dataset.columns import ACTION, NEXT_STATE, RESERVED, STATE, TERMINATED, Array, Column, Episode
from astra_data.dataset.reader import Dataset

SHOWN = 5  # episodes that a line names; further ones are counted
ANGLE = re.compile(r"(.+_)?(heading|yaw|theta|psi|roll|pitch|angle|q\d*|joint\d*)")  # names of angles
QUATERNION = re.compile(r"(.+_)?(q|quat(ernion)?|orient(ation)?|rot(ation)?)_?")  # what comes before its x, y, z, w
TURNS = {"rad": 2 * math.pi, "deg": 360.0}  # what a full turn is in each unit
LARGEST = 4 * math.pi  # few robots turn further than twice around


@dataclass(frozen=True)
class Finding:
    """What was found, and what to do about it."""

    severity: Literal["warning", "note"]  # a warning if a grounding would be fitted to what the robot did not do
    what: str
    advice: str
    episodes: tuple[int, ...] = ()  # uids of the episodes where it is; empty if it concerns the whole dataset

    def __str__(self) -> str:
        word = "episode" if len(self.episodes) == 1 else "episodes"
        where = f" ({word} {first_few(self.episodes, SHOWN)})" if self.episodes else ""
        return f"{self.severity}: {self.what}{where}: {self.advice}"


def deletion(called: str, uids: Sequence[int]) -> str:
    """Return the command that leaves `uids` out of the dataset `called`; it spells the first `SHOWN`."""
    options = " ".join(f"--without {uid}" for uid in uids[:SHOWN])
    return f"astra-data filter {called} {options}" + (" ..." if len(uids) > SHOWN else "")


def channels(column: Column, indices: Sequence[int]) -> str:
    """Name the values `indices` of `column`: "x, y of observation.state"."""
    if column.size == 1:
        return column.name
    return f"{', '.join(column.labels[index] for index in indices)} of {column.name}"


def is_angle(name: str) -> bool:
    """Return whether `name` is one of an angle, as "base.theta" or "Yaw.pos"."""
    return ANGLE.fullmatch(re.sub(r"_(pos|position|rad|deg)$", "", _plain(name))) is not None


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower())


def quaternions(column: Column) -> list[list[int]]:
    """Return the indices of each quaternion of a column, by its roles or else its names; some have z and w alone."""
    at, indices = {_plain(label): index for index, label in enumerate(column.labels)}, [*range(column.size)]
    stems = [label[:-1] for label in at if label.endswith("w") and QUATERNION.fullmatch(label[:-1])]
    named = [[at[f"{stem}{end}"] for end in "xyzw" if f"{stem}{end}" in at] for stem in stems]
    return [indices[part] for role, part in column.roles if role == "quaternion"] or [p for p in named if len(p) > 1]


def full_turns(column: Column, farthest: Floats | None = None) -> Floats:
    """Return what a full turn adds to each value of a column, (size,); 0 for values that are no angles.

    These have a unit or role that says so; with `farthest`, how far each is from 0, or no unit and an angle's name.
    """
    named = [2 * np.pi * (role == "heading") for role in (column.astra or {}).get("role", [""] * column.size)]
    for index, far in enumerate([] if farthest is None else farthest):
        if column.units[index] in ("", "1") and is_angle(column.labels[index]):
            named[index] = TURNS["rad" if far <= LARGEST else "deg"]
    return np.array([TURNS.get(unit, turn) for unit, turn in zip(column.units, named, strict=True)])


def shortest(steps: Floats, turns: Floats) -> Floats:
    """Return `steps` (T, S) less whole `turns` (S,), where these are not 0."""
    left: Floats = steps - turns * np.rint(np.divide(steps, turns, out=np.zeros_like(steps), where=turns > 0))
    return left


def torn_steps(episode: Episode) -> tuple[int, int]:
    """Return of how many steps the next state is not the state of the row after it, and of how many it could be."""
    state, arrived = as_rows(episode.columns[STATE]), as_rows(episode.columns[NEXT_STATE])
    return int((arrived[:-1] != state[1:]).any(axis=1).sum()), len(state) - 1


def continuity(counts: Mapping[int, tuple[int, int]]) -> list[Finding]:
    """Tell of the `torn_steps` of each episode, by its uid, if there are any."""
    uids = tuple(uid for uid, (count, _) in counts.items() if count)
    broken, steps = (sum(each) for each in zip(*counts.values(), strict=True))
    what = f"steps whose {NEXT_STATE} is not the state of the next row: {broken} of {steps}"
    remedy = f"without {NEXT_STATE} in the mapping if each row is the state after the one before"
    advice = f"rows are missing, or the columns come from different logs: import again, {remedy}"
    return [Finding("warning", what, advice, uids)] if uids else []


GAP = 1.5  # a step that takes more than so many periods is a gap
HELD = 0.75  # periods for which an MCAP topic may be held, as is proposed: rows that lack a message hold one longer
WRONG_RATE = 0.05  # relative difference of the recorded rate above which the declared one is wrong
JITTERY = 0.2  # periods by which 5 % of the steps are off at least in a jittery recording
MANY_GAPS = 0.01  # share of the steps from which on gaps are many
INNER = 0.95  # share of the steps that the rate and the jitter are of
FINE = 1000  # shares of a period, and `MOST_PERIODS` of them, beyond which a step is in another unit than is thought
MOST_PERIODS = 100
_COARSE = 0.1  # periods between neighboring times in float32 above which they stand still by rounding
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}


def is_clock(column: Column) -> bool:
    """Return whether a column holds times: one number, and a name that ends in time, stamp or timestamp."""
    named = re.fullmatch(r"(.*[._/])?(time|stamp|timestamp)(_(s|ms|us|ns))?", column.name.lower())
    return column.size == 1 and column.dtype != "bool" and column.name not in RESERVED and named is not None


@dataclass
class Clock:
    """The times that are called `name`, in `scale` s, of a recording of `fps` declared steps per second."""

    name: str
    fps: int
    scale: float = 1.0
    is_whole: bool = False  # whether the times are integers
    steps_s: list[Floats] = field(default_factory=list)  # of each episode, (n,)
    uids: list[int] = field(default_factory=list)
    farthest_s: float = 0.0  # the largest time

    @classmethod
    def of(cls, column: Column, fps: int) -> Self:
        """Return a clock of the times in `column` (T,), in its unit, by default s."""
        unit = column.units[0] or column.name.lower().rpartition("_")[2]
        return cls(column.name, fps, _SECONDS.get(unit, 1.0), column.dtype == "int64")

    def add(self, episode: Episode) -> None:
        """Count the steps between the times of the next episode."""
        times_s = episode.columns[self.name].astype(np.float64) * self.scale
        self.farthest_s = max(self.farthest_s, float(np.abs(times_s).max()))
        self.count(np.diff(times_s), episode.uid)

    def count(self, steps_s: Floats, uid: int = 0) -> None:
        """Count steps of the episode `uid`, (n,) in s."""
        self.steps_s.append(steps_s)
        self.uids.append(uid)

    def rates(self) -> tuple[float, int, float, float]:
        """Return period in s (mean of the `INNER` steps), number and share of gaps, jitter in periods; or zeros."""
        every = np.concatenate([*self.steps_s, np.zeros(0)])
        steps_s = np.sort(every[every > 0])
        if 2 * len(steps_s) <= len(every):
            return 0.0, 0, 0.0, 0.0
        first, last = (int(len(steps_s) * share) for share in ((1 - INNER) / 2, (1 + INNER) / 2))
        period_s = float(steps_s[first : max(last, first + 1)].mean())
        regular = steps_s[steps_s <= GAP * period_s]
        gaps = len(steps_s) - len(regular)
        jitter = float(np.quantile(np.abs(regular - period_s), INNER) / period_s) if len(regular) else 0.0
        return period_s, gaps, gaps / len(steps_s), jitter

    def __str__(self) -> str:
        declared, (period_s, gaps, share, jitter) = f"{self.fps} Hz declared", self.rates()
        if not period_s:
            return f"{declared}; {self.name} does not increase in most steps"
        if off := self._off(period_s):
            return f"{declared}, and {off} by {self.name}"
        missing = f" ({100 * share:.0f} % of the steps: rows are missing)" if share >= MANY_GAPS else ""
        found = f"gaps within episodes: {gaps}{missing}, jitter {100 * jitter:.1f} % of a period"
        return f"{declared}, {1 / period_s:.4g} Hz by {self.name}; {found}"

    def findings(self, called: str) -> list[Finding]:
        """Tell a wrong rate, gaps, jitter, and where time stands still or goes back."""
        found, (period_s, gaps, share, jitter) = [], self.rates()
        if standing := [u for u, steps_s in zip(self.uids, self.steps_s, strict=True) if (steps_s <= 0).any()]:
            of_mcap = "in MCAP for an `fps` that is too high or a topic that drops out (`gap_s`)"
            remedy = f"look for duplicate rows in the log or a clock that was set back, and {of_mcap}"
            if not self.is_whole and float(np.spacing(np.float32(self.farthest_s))) * self.fps > _COARSE:
                remedy = "store it as seconds since the start (`offset`) or as int64"
            what = f"{self.name} stands still or goes back between steps"
            advice = f"{remedy}, or leave the episodes out: {deletion(called, standing)}"
            found.append(Finding("warning", what, advice, tuple(standing)))
        if not period_s:
            return found
        if off := self._off(period_s):
            advice = "give its `unit` (s, ms, us or ns) or correct `fps` in the mapping, and import again"
            return [*found, Finding("warning", f"{off}, by {self.name}", advice)]
        if abs(1 / period_s / self.fps - 1) > WRONG_RATE:
            what = f"{self.name} runs at {1 / period_s:.4g} Hz, but {self.fps} Hz is declared"
            found.append(Finding("warning", what, "correct `fps` in the mapping, or resample, and import again"))
        if gaps:
            longest = [float(steps_s.max(initial=0.0)) for steps_s in self.steps_s]
            uids = [uid for uid, s in zip(self.uids, longest, strict=True) if s > GAP * period_s]
            of_mcap = f'for MCAP, `gap_s = {HELD * period_s:.3g}` in [columns."{self.name}"]'
            split = f"`time`, and `gap_s = {GAP * period_s:.3g}` in [split], of the mapping"
            remedy = f"begin new episodes there ({split}; {of_mcap})"
            if share >= MANY_GAPS:  # many gaps are a recording of another rate, of which splits would leave crumbs
                remedy = f"resample the recording (of MCAP, take an `fps` that divides its rate), or {remedy}"
            what = f"steps of over {GAP:g} periods: {gaps}, the longest {max(longest):.3g} s"
            found.append(Finding("warning", what, f"{remedy} and import again", tuple(uids)))
        if jitter > JITTERY:
            what = f"5 % of the steps are off by {100 * jitter:.0f} % of a period or more, by {self.name}"
            found.append(Finding("note", what, f"resample the recording to {self.fps} Hz and import again"))
        return found

    def _off(self, period_s: float) -> str:
        """Say how long a step is, if it is so long or short that the unit is another than is thought."""
        periods = period_s * self.fps
        if 1 / FINE <= periods < MOST_PERIODS:
            return ""
        return "a step takes " + (f"1/{FINE} of a period or less" if periods < 1 else f"{MOST_PERIODS} periods or more")


SATURATED = 0.2  # share of steps at the edge of the range above which a command is saturated
DISCRETE = 8  # a command with at most so many different values is a choice among them and has no edge
STUCK = 0.5  # share of an episode without any change above which a value is stuck, if others move in as many steps
MOST = 0.5  # share of the episodes above which they are most
SMALLEST_SPAN = 0.01  # share of its range that a value moves through in most episodes: less is noise of a simulator
MOVING = 0.1  # longest rest in most episodes: what often rests, such as a ball, is not stuck where it does
FEWEST_STEPS = 10  # shorter episodes tell nothing of it
FEW_FAILURES = 10  # fewer failures are little for a failure model (docs/results/failures.md)
MOST_REPEATED = 0.05  # share of the steps above which states that repeat the row before, between moving ones, are many
MOST_ROWS = 5  # rows in a row that repeat a state; a robot that stands still does so for longer
LAGS = range(-3, 4)  # rows between a step and the action that is tried as its cause
CLEAR = 0.2  # by how much more of the variance of steps another row's action explains, where rows are off
MOST_STEPS = 2**13  # steps that a shift is estimated from


@dataclass(frozen=True)
class Checkup:
    """What a check-up found."""

    summary: tuple[str, ...]  # a line each on how episodes end, on commands and on the rate
    findings: tuple[Finding, ...]  # warnings first


def check_up(dataset: Dataset, called: str | None = None) -> Checkup:
    """Look at all episodes of `dataset`, one at a time; commands call it `called`."""
    called = called or dataset.reference
    fps, uids = int(dataset.info["fps"]), dataset.uids.tolist()
    columns = {column.name: column for column in dataset.schema}
    clocks = [Clock.of(column, fps) for column in columns.values() if is_clock(column)]
    doubled, apart, motions = list[tuple[int, int]](), dict[int, tuple[int, int]](), list[_Motion]()
    ended: list[bool] = []
    looked_at = [name for name in (STATE, NEXT_STATE, TERMINATED) if name in columns]
    for episode in dataset.episodes([*looked_at, *(clock.name for clock in clocks)]):
        for clock in clocks:
            clock.add(episode)
        if TERMINATED in columns:
            ended.append(bool(episode.columns[TERMINATED][-1]))
        if STATE in columns:
            state = as_rows(episode.columns[STATE])
            doubled.append(repeated(state))
            if len(state) >= FEWEST_STEPS:
                changes, ends = state[1:] != state[:-1], (state.min(axis=0), state.max(axis=0))
                low, high = (end.astype(np.float64) for end in ends)
                moves = bool(changes.any(axis=1).mean() > STUCK)
                motions.append((episode.uid, longest_rests(changes) / len(changes), low, high, moves))
            if NEXT_STATE in columns:
                apart[episode.uid] = torn_steps(episode)
    # What the import said of rates and of rounding, where the dataset is one.
    notes, topics = (dataset.description.get(key) for key in ("notes", "topics"))
    noted = [*(notes if isinstance(notes, list) else []), *(topics if isinstance(topics, dict) else [])]
    advice = "correct the mapping and import again, unless it is meant"
    found = [Finding("warning", f"at import, {note}", advice) for note in noted]
    found += [finding for clock in clocks for finding in clock.findings(called)]
    statistics = dataset.statistics()
    ranges = {name: np.array([statistics[name][key] for key in ("min", "max")], np.float64) for name in columns}
    if STATE in columns:
        found += repeats(doubled)
        both = dataset.episodes([STATE, ACTION]) if ACTION in columns else ()
        found += shift((as_rows(one.columns[STATE]), as_rows(one.columns[ACTION])) for one in both)
        found += large_angles(columns[STATE], np.abs(ranges[STATE]).max(axis=0))
        found += continuity(apart) if apart else []
    found += duplicates(dataset.digests, uids, called)
    # What is the same where episodes begin is not constant, where none goes on.
    if STATE in columns and dataset.lengths.max() > 1:
        found += constant(columns[STATE], ranges[STATE])
        found += stuck(columns[STATE], motions, called)
    summary = []
    if ACTION in columns:
        found += constant(columns[ACTION], ranges[ACTION])
        actions = (as_rows(episode.columns[ACTION]) for episode in dataset.episodes([ACTION]))
        line, more = commands(columns[ACTION], actions, ranges[ACTION], fps)
        summary, found = [f"commands: {line}"], found + more
    line, more = endings(uids, dataset.lengths, np.array(ended) if ended else None, dataset.successes())
    found = sorted(found + more, key=lambda finding: finding.severity != "warning")
    rates = [str(clock) for clock in clocks] or [f"{fps} Hz declared; no time column to compare it with"]
    summary = [f"endings: {line}", *summary, *(f"rate: {rate}" for rate in rates)]
    return Checkup(tuple(summary), tuple(found))


def commands(column: Column, episodes: Iterable[Array], extremes: Floats, fps: int) -> tuple[str, list[Finding]]:
    """Say how long the commands (T, A) of episodes are held, how often at an edge of their range, and where too often.

    `extremes` (2, A) are the smallest and the largest of all; a choice among few commands has no edge.
    """
    names, held, steps = column.names or ([column.name] if column.size == 1 else column.labels), Counter[int](), 0
    at_edge, seen = np.zeros(column.size, np.int64), list[Array]([np.zeros(0)] * column.size)
    for actions in episodes:
        held.update(held_steps(actions).tolist())
        at_edge += ((actions == extremes[0]) | (actions == extremes[1])).sum(axis=0)
        seen = [few if len(few) > DISCRETE else np.union1d(few, new) for few, new in zip(seen, actions.T, strict=True)]
        steps += len(actions)
    shares = np.where([len(values) > DISCRETE for values in seen], at_edge / steps, 0.0)
    durations = np.array(sorted(held)) / fps
    count = np.cumsum([held[length] for length in sorted(held)])
    median_s, long_s = (float(durations[np.searchsorted(count, share * count[-1])]) for share in (0.5, 0.95))
    most = np.sort(np.argsort(-shares, kind="stable")[:SHOWN])
    edges = ", ".join(f"{names[index]} {100 * shares[index]:.1f} %" for index in most)
    edges += f" and {len(names) - SHOWN} less often" if len(names) > SHOWN else ""
    line = f"held {median_s:.3g} s (median), {long_s:.3g} s (95 %); steps at the edge of the range: {edges}"
    saturated = channels(column, np.flatnonzero(shares > SATURATED).tolist())
    what = f"commands at the edge of their range in up to {100 * shares.max():.0f} % of steps, {saturated}"
    remedy = "compare the range with what the robot follows (`clip` in the mapping), or record gentler commands"
    advice = f"values in between are rarer in the data: {remedy}"
    return line, [Finding("note", what, advice)] if shares.max() > SATURATED else []


def held_steps(actions: Array) -> Ints:
    """Return the lengths of the runs of equal rows in `actions` (T, A), without one of many that the end cuts off."""
    changes = np.flatnonzero((actions[1:] != actions[:-1]).any(axis=1)) + 1
    return np.diff(np.concatenate([[0], changes if len(changes) else [len(actions)]]))


def large_angles(column: Column, farthest: Floats) -> list[Finding]:
    """Tell which angles in rad are larger than `LARGEST`; `farthest` (size,) is the largest of each value."""
    large = [index for index, unit in enumerate(column.units) if unit == "rad" and farthest[index] > LARGEST]
    if not large:
        return []
    what = f"{channels(column, large)}: up to {farthest[large].max():.4g} rad, which is more than two full turns"
    return [Finding("warning", what, "if these are degrees, set `scale` to 0.0174533 in the mapping and import again")]


def constant(column: Column, extremes: Floats) -> list[Finding]:
    """Tell which values of a column have the same smallest and largest value, (2, size)."""
    indices = np.flatnonzero(extremes[0] == extremes[1]).tolist()
    if not indices:
        return []
    why = "a dead sensor, or nothing to learn from: check the log"
    if column.name == ACTION:
        why = "its effect cannot be learned: vary it in a recording"
    what = f"constant in all steps: {channels(column, indices)}"
    return [Finding("note", what, f"{why}, or leave it out of the mapping")]


_Motion = tuple[int, Floats, Floats, Floats, bool]
"""Uid of an episode, its longest rests (S,) as a share of its steps, the extremes (S,) of its values, and whether most
steps move."""


def stuck(column: Column, motions: Sequence[_Motion], called: str) -> list[Finding]:
    """Tell which values rest in some episodes and move in most."""
    if not motions:
        return []
    uids, rests, lows, highs, others_move = (np.array(part) for part in zip(*motions, strict=True))
    spans, whole = highs - lows, highs.max(axis=0) - lows.min(axis=0)
    moves = np.mean((rests < MOVING) & (spans > SMALLEST_SPAN * whole), axis=0) > MOST
    found = (rests > STUCK) & others_move[:, None] & moves
    indices, where = np.flatnonzero(found.any(axis=0)).tolist(), uids[found.any(axis=1)].tolist()
    what = f"stuck for over half of an episode while others move: {channels(column, indices)}"
    return [Finding("warning", what, f"leave them out: {deletion(called, where)}", tuple(where))] if where else []


def longest_rests(changes: Bools) -> Ints:
    """Return the longest run of steps without a change in each column of `changes` (T, S)."""
    steps = np.arange(1, len(changes) + 1)[:, None]
    longest: Ints = (steps - np.maximum.accumulate(np.where(changes, steps, 0), axis=0)).max(axis=0)
    return longest


def duplicates(digests: Mapping[str, NDArray[np.uint64]], uids: Sequence[int], called: str) -> list[Finding]:
    """Tell which episodes have the same states and actions, to the bit, by their digests (E,)."""
    first, copies = dict[tuple[int, ...], int](), dict[int, int]()
    keys = [digests[name].tolist() for name in (STATE, ACTION) if name in digests]
    for uid, *key in zip(uids, *keys, strict=True):
        if key and first.setdefault(tuple(key), uid) != uid:
            copies[uid] = first[tuple(key)]
    if not copies:
        return []
    copy, original = next(iter(copies.items()))
    what = f"copies of other episodes: {len(copies)}; {copy} has the states and actions of {original}"
    advice = f"they count twice, and may be both in training and held out: {deletion(called, [*copies])}"
    return [Finding("warning", what, advice, tuple(copies))]


def endings(
    uids: Sequence[int], lengths: Ints, terminated: Bools | None, successes: Sequence[bool | None] | None
) -> tuple[str, list[Finding]]:
    """Count the ways in which episodes end; tell whether none goes on after its first step, and of few failures."""
    ended: Bools = np.zeros(len(uids), bool) if terminated is None else terminated
    known = successes or [None] * len(uids)
    succeeded = np.array([success is True for success in known])
    failed = np.array([success is False for success in known]) & ended
    others, limit = ~succeeded & ~ended, lengths.max()
    # One alone that is longer than all others need not have met a limit.
    timed = others & (lengths == limit) & ((lengths == limit).sum() > 1)
    counts = {
        "in success": succeeded,
        "in failure": failed,
        "terminated, success unknown": ended & ~succeeded & ~failed,
        f"after {limit} steps, the longest (a time limit)": timed,
        "cut": others & ~timed,
    }
    line = ", ".join(f"{which.sum()} {way}" for way, which in counts.items() if which.any())
    if terminated is None and successes is None:
        line = "unknown: neither success nor next.terminated was recorded"
    found, failures = [], [uid for uid, failure in zip(uids, failed, strict=True) if failure]
    if limit == 1:
        advice = "check what ends them: failed of robot or log, reached, missed of objective, or a mapping's [split]"
        found.append(Finding("warning", "every episode ends after its first step", advice))
    if 0 < len(failures) < FEW_FAILURES:
        count = "1 failure" if len(failures) == 1 else f"{len(failures)} failures"
        advice = f"record {FEW_FAILURES} or more (astra-data collect TASK --behavior stress), or none can be predicted"
        what = f"{count}, which is little for a failure model to learn from"
        found.append(Finding("note", what, advice, tuple(failures)))
    return line, found


def repeated(state: Array) -> tuple[int, int]:
    """Return how many rows (T, S) repeat the one before to the bit while the robot moves, and how many could."""
    runs = np.diff(np.flatnonzero((state[1:] != state[:-1]).any(axis=1))) - 1
    return int(runs[runs <= MOST_ROWS].sum()), len(state) - 1


def repeats(counts: Sequence[tuple[int, int]]) -> list[Finding]:
    """Tell where many rows are `repeated`, of the counts of each episode."""
    often, steps = (sum(each) for each in zip(*counts, strict=True))
    why = "the log is faster than its sensor, or rows were written twice"
    what = f"{often} of {steps} steps repeat the state of the row before to the bit, between steps that move: {why}"
    advice = "leave out the repeated rows, correct `fps`, and import again"
    return [Finding("warning", what, advice)] if often > MOST_REPEATED * steps else []


def shift(episodes: Iterable[tuple[Array, Array]]) -> list[Finding]:
    """Tell by how many rows the actions of the steps are off, if they are; `episodes` are states and actions."""
    rows, steps = list[tuple[Floats, Floats]](), 0
    for episode in episodes:
        if len(episode[0]) > len(LAGS):
            state, action = (values[:MOST_STEPS].astype(float) for values in episode)
            rows.append((state, action))
            steps += len(state)
            if steps >= MOST_STEPS:
                break
    width = sum(part.shape[1] for part in rows[0]) if rows else 0
    if steps < 20 * (width + len(LAGS)) or not any(np.ptp(state, axis=0).any() for state, _ in rows):
        return []
    shares = _explained(rows)
    best, at_zero = LAGS[int(shares.argmax())], float(shares[LAGS.index(0)])
    if shares.max() - at_zero < CLEAR:
        return []
    off = f"{abs(best)} row{'s' if abs(best) > 1 else ''}"
    explains = f"explains {shares.max():.0%} of their variance, that of their own row {at_zero:.0%}"
    if best > 0:
        what = f"steps follow from the action {off} later, which {explains}: actions are in later rows"
        return [Finding("warning", what, f"move the actions up by {off} and import again")]
    what = f"steps follow from the action {off} earlier, which {explains}: commands act late"
    return [Finding("note", what, f"move the actions down by {off} and import again, unless the robot has that delay")]


def _explained(rows: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Return how much of the variance of steps the action of each of `LAGS` explains beside the state."""
    widest = max(LAGS)
    before = np.concatenate([state[widest : -1 - widest] for state, _ in rows])
    steps = np.concatenate([np.diff(state, axis=0)[widest : len(state) - 1 - widest] for state, _ in rows])
    steps = steps[:, np.ptp(steps, axis=0) > 0]
    if not steps.size:
        return np.zeros(len(LAGS))
    steps = (steps - steps.mean(axis=0)) / steps.std(axis=0)
    known, shares = np.column_stack([np.ones(len(before)), before]), []
    for lag in LAGS:
        parts = [action[widest + lag : len(action) - 1 - widest + lag] for _, action in rows]
        design = np.column_stack([known, np.concatenate(parts)])
        design /= np.maximum(np.abs(design).max(axis=0), 1e-30)
        rest = steps - design @ np.linalg.lstsq(design, steps)[0]
        shares.append(1 - float((rest**2).mean()))
    return np.array(shares)
