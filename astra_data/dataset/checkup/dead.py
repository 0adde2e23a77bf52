"""Values that are constant in all of a dataset, or stuck for most of an episode while others move."""

import numpy as np
from numpy.typing import NDArray

from astra_data.core.numbers import as_rows
from astra_data.dataset.checkup.finding import Finding, channels, deletion
from astra_data.dataset.columns import ACTION, STATE, Array, Column, Episode

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
                advice = (
                    "a dead sensor, or nothing to learn from: check the log, or leave it out of the mapping"
                )
                if column.name == ACTION:
                    advice = (
                        "its effect cannot be learned: vary it in a recording, or leave it out of the mapping"
                    )
                what = f"constant in all steps: {channels(column, constant)}"
                found.append(Finding("note", what, advice))
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
