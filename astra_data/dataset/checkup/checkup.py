"""Check a dataset up in one pass: how episodes end, which commands were given, its rate, and findings."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats, as_rows
from astra_data.dataset.checkup.findings import (
    SHOWN,
    Angles,
    Clock,
    Continuity,
    Finding,
    channels,
    deletion,
    is_clock,
    labels,
)
from astra_data.dataset.columns import ACTION, NEXT_STATE, REWARD, STATE, TERMINATED, Array, Column, Episode
from astra_data.dataset.description import digest_of
from astra_data.dataset.inspection import is_terminated
from astra_data.dataset.reader import Dataset

LOOKED_AT = (STATE, ACTION, NEXT_STATE, REWARD, TERMINATED)
SATURATED = 0.2
"""Share of steps at the edge of the range above which a command is saturated."""
DISCRETE = 8
"""A command with at most so many different values is a choice among them and has no edge."""
STUCK = 0.5
"""Share of an episode without any change above which a value is stuck, if others move in as many steps."""
MOST = 0.5
"""Share of the episodes above which they are most."""
SMALLEST_SPAN = 0.01
"""Share of its whole range that a value moves through in most episodes: noise of a simulator is no motion."""
MOVING = 0.1
"""Longest rest in most episodes: what often rests, such as a ball, is not stuck where it does."""
FEWEST_STEPS = 10
"""Shorter episodes tell nothing of it."""
FEW_FAILURES = 10
"""Fewer failures are little for a failure model (docs/results/failures.md)."""
MOST_REPEATED = 0.05
"""Share of the steps above which states that repeat the row before, between others that move, are many."""
MOST_ROWS = 5
"""Rows in a row that repeat a state; a robot that stands still does so for longer."""
LAGS = range(-3, 4)
"""Rows between a step and the action that is tried as its cause."""
CLEAR = 0.2
"""By how much more of the variance of steps another row's action explains, where rows are off."""
MOST_STEPS = 2**13
"""Steps that a shift is estimated from."""


class _Part(Protocol):
    """One question that is asked of every episode."""

    def add(self, episode: Episode) -> None:
        """Take the next episode."""

    def findings(self, called: str) -> list[Finding]:
        """Return what was found; commands call the dataset `called`."""


@dataclass(frozen=True)
class Checkup:
    """What a check-up found."""

    reference: str
    """Name and version of the dataset."""
    summary: tuple[str, ...]
    """A line each on how episodes end, on commands and on the rate."""
    findings: tuple[Finding, ...]
    """Warnings first."""

    def record(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "dataset": self.reference,
            "summary": list(self.summary),
            "findings": [finding.record() for finding in self.findings],
        }


def check_up(dataset: Dataset, called: str | None = None) -> Checkup:
    """Look at all episodes of `dataset`, one at a time; commands call it `called`."""
    called = called or dataset.reference
    fps = int(dataset.info["fps"])
    columns = {column.name: column for column in dataset.schema}
    clocks = [Clock.of(column, fps) for column in columns.values() if is_clock(column)]
    ends = EpisodeEnds(dataset.successes())
    commands = [GivenCommands(columns[ACTION], fps)] if ACTION in columns else []
    angles = [Angles(columns[STATE])] if STATE in columns else []
    parts: list[_Part] = [*clocks, Repeats(), Shift(), *angles, Continuity(), Duplicates()]
    parts += [DeadChannels(list(columns.values())), *commands, ends]
    names = [column.name for column in columns.values() if column.name in LOOKED_AT or is_clock(column)]
    for episode in dataset.episodes(names or list(columns)):
        for part in parts:
            part.add(episode)
    findings = _of_import(dataset) + [finding for part in parts for finding in part.findings(called)]
    findings.sort(key=lambda finding: finding.severity != "warning")
    rates = [str(clock) for clock in clocks] or [f"{fps} Hz declared; no time column to compare it with"]
    summary = [f"endings: {ends}", *(f"commands: {given}" for given in commands)]
    summary += [f"rate: {rate}" for rate in rates]
    return Checkup(dataset.reference, tuple(summary), tuple(findings))


def _of_import(dataset: Dataset) -> list[Finding]:
    """Return what the import said of rates and of rounding, where the dataset is one."""
    notes, topics = (dataset.description.get(key) for key in ("notes", "topics"))
    found = [*(notes if isinstance(notes, list) else []), *(topics if isinstance(topics, dict) else [])]
    advice = "correct the mapping and import again, unless it is meant"
    return [Finding("warning", f"at import, {note}", advice) for note in found]


class GivenCommands:
    """The commands of a dataset, whose actions are `column` (T, A)."""

    def __init__(self, column: Column, fps: int) -> None:
        self._column, self._fps = column, fps
        # Per command the smallest and the largest value, and how many steps have it.
        self._edges = np.array([[np.inf], [-np.inf]]).repeat(column.size, axis=1)
        self._at_edge: NDArray[np.int64] = np.zeros((2, column.size), np.int64)
        self._values: list[set[float]] = [set() for _ in range(column.size)]
        self._held: Counter[int] = Counter()
        self._steps = 0

    def add(self, episode: Episode) -> None:
        """Count the commands of the next episode."""
        actions = as_rows(episode.columns[ACTION])
        self._steps += len(actions)
        for side, extreme in enumerate((actions.min(axis=0), actions.max(axis=0))):
            beyond = extreme < self._edges[side] if side == 0 else extreme > self._edges[side]
            self._edges[side][beyond] = extreme[beyond]
            self._at_edge[side][beyond] = 0
            self._at_edge[side] += (actions == self._edges[side]).sum(axis=0)
        for values, found in zip(self._values, actions.T, strict=True):
            if len(values) <= DISCRETE:
                values.update(np.unique(found)[: DISCRETE + 1].tolist())
        self._held.update(held_steps(actions).tolist())

    @property
    def edge_shares(self) -> NDArray[np.float64]:
        """Share of steps at the edge of the range, of each command (A,); 0 where it is a choice of few."""
        shares: NDArray[np.float64] = self._at_edge.sum(axis=0) / self._steps
        shares[[len(values) <= DISCRETE for values in self._values]] = 0.0
        return shares

    def held_s(self, quantile: float) -> float:
        """Return for how long a command is held, in s: a quantile over commands."""
        steps = np.array(sorted(self._held))
        count = np.cumsum([self._held[length] for length in steps.tolist()])
        return float(steps[np.searchsorted(count, quantile * count[-1])] / self._fps)

    def __str__(self) -> str:
        """Say how long commands are held and how often they are at the edge of their range."""
        names, edge_shares = labels(self._column), self.edge_shares
        most = np.sort(np.argsort(-edge_shares, kind="stable")[:SHOWN])
        shares = ", ".join(f"{names[index]} {100 * edge_shares[index]:.1f} %" for index in most)
        shares += f" and {len(names) - SHOWN} less often" if len(names) > SHOWN else ""
        return (
            f"held {self.held_s(0.5):.3g} s (median), {self.held_s(0.95):.3g} s (95 %); steps at the edge of "
            f"the range: {shares}"
        )

    def findings(self, called: str = "") -> list[Finding]:
        """Tell which commands are saturated."""
        saturated = np.flatnonzero(self.edge_shares > SATURATED)
        if not len(saturated):
            return []
        names = channels(self._column, saturated.tolist())
        worst = self.edge_shares.max()
        what = f"commands at the edge of their range in up to {100 * worst:.0f} % of steps, {names}"
        advice = (
            "values in between are rarer in the data: compare the range with what the robot follows "
            "(`clip` in the mapping), or record gentler commands"
        )
        return [Finding("note", what, advice)]


def held_steps(actions: Array) -> NDArray[np.int64]:
    """Return the lengths of the runs of equal rows in `actions` (T, A), without one that the end cuts off.

    A single run is returned though it is cut off.
    """
    changes = np.flatnonzero((actions[1:] != actions[:-1]).any(axis=1)) + 1
    return np.diff(np.concatenate([[0], changes if len(changes) else [len(actions)]]))


class DeadChannels:
    """The values of states and actions in `columns` that do not change."""

    def __init__(self, columns: list[Column]) -> None:
        self._columns = [column for column in columns if column.name in (STATE, ACTION)]
        self._first: dict[str, Array] = {}
        self._changed = {column.name: np.zeros(column.size, bool) for column in self._columns}
        self._rests: list[NDArray[np.float64]] = []
        self._extremes: list[NDArray[np.float64]] = []
        self._others_move: list[bool] = []
        self._uids: list[int] = []
        self._goes_on = False

    def add(self, episode: Episode) -> None:
        """Look at the next episode."""
        self._goes_on |= len(episode) > 1
        for column in self._columns:
            values = as_rows(episode.columns[column.name])
            first = self._first.setdefault(column.name, values[0].copy())
            self._changed[column.name] |= (values != first).any(axis=0)
            if column.name == STATE and len(values) >= FEWEST_STEPS:
                changes = values[1:] != values[:-1]
                self._rests.append(longest_rests(changes) / len(changes))
                self._extremes.append(np.array([values.min(axis=0), values.max(axis=0)], np.float64))
                self._others_move.append(bool(changes.any(axis=1).mean() > STUCK))
                self._uids.append(episode.uid)

    def findings(self, called: str) -> list[Finding]:
        """Tell which values are constant, and which are stuck in some episodes.

        What is the same where episodes begin is not, where none goes on.
        """
        found = []
        for column in self._columns:
            if column.name == STATE and not self._goes_on:
                continue
            constant = np.flatnonzero(~self._changed[column.name]).tolist()
            if constant:
                why = "a dead sensor, or nothing to learn from: check the log"
                if column.name == ACTION:
                    why = "its effect cannot be learned: vary it in a recording"
                what = f"constant in all steps: {channels(column, constant)}"
                found.append(Finding("note", what, f"{why}, or leave it out of the mapping"))
            if column.name == STATE and self._rests:
                found += self._stuck(column, called)
        return found

    def _stuck(self, column: Column, called: str) -> list[Finding]:
        rests, extremes = np.array(self._rests), np.array(self._extremes)
        lows, highs = extremes[:, 0], extremes[:, 1]
        spans, whole = highs - lows, highs.max(axis=0) - lows.min(axis=0)
        moves = np.mean((rests < MOVING) & (spans > SMALLEST_SPAN * whole), axis=0) > MOST
        stuck = (rests > STUCK) & np.array(self._others_move)[:, None] & moves
        indices = np.flatnonzero(stuck.any(axis=0)).tolist()
        uids = np.array(self._uids)[stuck.any(axis=1)].tolist()
        if not indices:
            return []
        what = f"stuck for over half of an episode while others move: {channels(column, indices)}"
        return [Finding("warning", what, f"leave them out: {deletion(called, uids)}", tuple(uids))]


def longest_rests(changes: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the longest run of steps without a change in each column of `changes` (T, S)."""
    steps = np.arange(1, len(changes) + 1)[:, None]
    last_change = np.maximum.accumulate(np.where(changes, steps, 0), axis=0)
    longest: NDArray[np.int64] = (steps - last_change).max(axis=0)
    return longest


class Duplicates:
    """Episodes of the same states and actions, to the bit, by their digests."""

    def __init__(self) -> None:
        self._first: dict[tuple[int, ...], int] = {}
        self._copies: dict[int, int] = {}

    def add(self, episode: Episode) -> None:
        """Compare the next episode with those before."""
        names = (name for name in (STATE, ACTION) if name in episode.columns)
        key = tuple(digest_of(episode.columns[name]) for name in names)
        if not key:
            return
        first = self._first.setdefault(key, episode.uid)
        if first != episode.uid:
            self._copies[episode.uid] = first

    def findings(self, called: str) -> list[Finding]:
        """Tell which episodes are copies."""
        if not self._copies:
            return []
        uids = tuple(self._copies)
        first = self._copies[uids[0]]
        what = f"copies of other episodes: {len(uids)}; {uids[0]} has the states and actions of {first}"
        advice = f"they count twice, and may be both in training and held out: {deletion(called, uids)}"
        return [Finding("warning", what, advice, uids)]


class EpisodeEnds:
    """How each episode of a dataset ends."""

    def __init__(self, successes: Sequence[bool | None] | None) -> None:
        """Take whether each episode succeeds, in their order; None where or if it is unknown."""
        self._successes = successes
        self._lengths: list[int] = []
        self._terminated: list[bool] = []
        self._uids: list[int] = []
        self._marked = False

    def add(self, episode: Episode) -> None:
        """Count the next episode."""
        self._marked |= TERMINATED in episode.columns
        self._terminated.append(is_terminated(episode.columns))
        self._lengths.append(len(episode))
        self._uids.append(episode.uid)

    @property
    def failures(self) -> list[int]:
        """Uids of the episodes that are terminated without success, as far as that is known."""
        known = self._successes or [None] * len(self._uids)
        ends = zip(self._uids, self._terminated, known, strict=True)
        return [uid for uid, terminated, success in ends if terminated and success is False]

    def __str__(self) -> str:
        """Count the ways in which episodes end."""
        if not self._marked and self._successes is None:
            return "unknown: neither success nor next.terminated was recorded"
        known = np.array([success is True for success in self._successes or [False] * len(self._uids)])
        terminated, lengths = np.array(self._terminated), np.array(self._lengths)
        others = ~known & ~terminated
        limit = lengths.max()
        # One alone that is longer than all others need not have met a limit.
        timed = others & (lengths == limit) & ((lengths == limit).sum() > 1)
        failed, unknown = len(self.failures), int((terminated & ~known).sum()) - len(self.failures)
        counts = (
            (int(known.sum()), "in success"),
            (failed, "in failure"),
            (unknown, "terminated, success unknown"),
            (int(timed.sum()), f"after {limit} steps, the longest (a time limit)"),
            (int((others & ~timed).sum()), "cut"),
        )
        return ", ".join(f"{count} {way}" for count, way in counts if count)

    def findings(self, called: str = "") -> list[Finding]:
        """Tell whether no episode goes on after its first step, and of few failures, where there are any."""
        failures, found = self.failures, []
        if max(self._lengths, default=0) == 1:
            advice = (
                "check what ends them: failed of the robot or log, reached and missed of the objective, "
                "or how a mapping splits episodes"
            )
            found.append(Finding("warning", "every episode ends after its first step", advice))
        if 0 < len(failures) < FEW_FAILURES:
            count = "1 failure" if len(failures) == 1 else f"{len(failures)} failures"
            what = f"{count}, which is little for a failure model to learn from"
            advice = (
                f"record {FEW_FAILURES} or more failures (astra-data collect TASK --behavior stress), or "
                "no failure can be predicted from it"
            )
            found.append(Finding("note", what, advice, tuple(failures)))
        return found


class Repeats:
    """Counts the states that repeat the row before to the bit while the robot moves."""

    def __init__(self) -> None:
        self._steps = self._repeated = 0

    def add(self, episode: Episode) -> None:
        """Look at the next episode."""
        if STATE not in episode.columns:
            return
        state = as_rows(episode.columns[STATE])
        moves = np.flatnonzero((state[1:] != state[:-1]).any(axis=1))
        runs = np.diff(moves) - 1
        self._repeated += int(runs[runs <= MOST_ROWS].sum())
        self._steps += max(len(state) - 1, 0)

    def findings(self, called: str = "") -> list[Finding]:
        """Tell where many rows repeat the one before."""
        if self._repeated <= MOST_REPEATED * self._steps:
            return []
        what = (
            f"{self._repeated} of {self._steps} steps repeat the state of the row before to the bit, between "
            "steps that move: the log is faster than its sensor, or rows were written twice"
        )
        return [Finding("warning", what, "leave out the repeated rows, correct `fps`, and import again")]


class Shift:
    """Finds whether steps follow from actions of other rows better than from their own."""

    def __init__(self) -> None:
        self._rows: list[tuple[Floats, Floats]] = []
        self._steps = 0

    def add(self, episode: Episode) -> None:
        """Take the next episode, until there are enough steps."""
        columns = episode.columns
        if self._steps < MOST_STEPS and len(episode) > len(LAGS) and {STATE, ACTION} <= columns.keys():
            state, action = (as_rows(columns[name])[:MOST_STEPS].astype(float) for name in (STATE, ACTION))
            self._rows.append((state, action))
            self._steps += len(state)

    def explained(self) -> Floats:
        """Return how much of the variance of steps the action of each of `LAGS` explains beside the state."""
        widest = max(LAGS)
        inner = [slice(widest, len(state) - 1 - widest) for state, _ in self._rows]
        before = np.concatenate([state[rows] for (state, _), rows in zip(self._rows, inner, strict=True)])
        steps = np.concatenate(
            [np.diff(state, axis=0)[rows] for (state, _), rows in zip(self._rows, inner, strict=True)]
        )
        steps = steps[:, np.ptp(steps, axis=0) > 0]
        if not steps.size:
            return np.zeros(len(LAGS))
        steps = (steps - steps.mean(axis=0)) / steps.std(axis=0)
        known = np.column_stack([np.ones(len(before)), before])
        shares = []
        for lag in LAGS:
            parts = [action[widest + lag : len(action) - 1 - widest + lag] for _, action in self._rows]
            design = np.column_stack([known, np.concatenate(parts)])
            design /= np.maximum(np.abs(design).max(axis=0), 1e-30)
            rest = steps - design @ np.linalg.lstsq(design, steps)[0]
            shares.append(1 - float((rest**2).mean()))
        return np.array(shares)

    def findings(self, called: str = "") -> list[Finding]:
        """Return by how many rows actions are off, if they are."""
        width = sum(part.shape[1] for part in self._rows[0]) if self._rows else 0
        if self._steps < 20 * (width + len(LAGS)) or not any(np.ptp(state, axis=0).any() for state, _ in self._rows):
            return []
        shares = self.explained()
        best, own = LAGS[int(shares.argmax())], float(shares[LAGS.index(0)])
        if shares.max() - own < CLEAR:
            return []
        off = f"{abs(best)} row{'s' if abs(best) > 1 else ''}"
        explains = f"explains {shares.max():.0%} of their variance, that of their own row {own:.0%}"
        if best > 0:
            what = f"steps follow from the action {off} later, which {explains}: actions are in later rows"
            return [Finding("warning", what, f"move the actions up by {off} and import again")]
        what = f"steps follow from the action {off} earlier, which {explains}: commands act late"
        advice = f"move the actions down by {off} and import again, unless the robot has that delay"
        return [Finding("note", what, advice)]
