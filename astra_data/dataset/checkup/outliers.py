"""Episodes whose length, return or states are far from those of the others."""

from collections.abc import Iterator, Sequence

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.numbers import as_rows
from astra_data.dataset.checkup.finding import SHOWN, Finding, channels, deletion
from astra_data.dataset.columns import REWARD, STATE, Column, Episode
from astra_data.dataset.endings import is_terminated

OUTLYING = 8.0
"""Robust standard deviations from the median over episodes above which one is an outlier."""
FEWEST = 10
"""Among fewer episodes nothing can be called far from the others."""
INLYING = 0.95
"""Share of the episodes whose states make the range of the others."""
_TO_STD = 1.4826  # of a normal distribution: 1 / Φ⁻¹(3/4)
_SMALLEST_SCALE = 0.1
"""Of lengths, as logarithms, and of returns, relative to their median: less than that is no other episode."""


class Outliers:
    """Lengths, returns and reached states of the episodes of a dataset whose states are `column` (T, S)."""

    def __init__(self, column: Column | None, successes: Sequence[bool | None] | None) -> None:
        """Take whether each episode succeeds, too; None where or if it is unknown."""
        self._column, self._successes = column, successes
        self._uids: list[int] = []
        self._lengths: list[int] = []
        self._returns: list[float] = []
        self._ends: list[tuple[bool, bool]] = []
        self._extremes: list[Floats] = []

    def add(self, episode: Episode) -> None:
        """Measure the next episode."""
        columns = episode.columns
        success = self._successes is not None and self._successes[len(self._uids)] is True
        self._ends.append((success, is_terminated(columns)))
        self._uids.append(episode.uid)
        self._lengths.append(len(episode))
        if REWARD in columns:
            self._returns.append(float(columns[REWARD].sum(dtype=np.float64)))
        if self._column is not None:
            state = as_rows(columns[STATE])
            self._extremes.append(np.array([state.min(axis=0), state.max(axis=0)], np.float64))

    def findings(self, called: str) -> list[Finding]:
        """Name the outliers, each with the reason."""
        reasons: dict[int, list[str]] = {}
        for values, name, unit, is_log in self._figures():
            for position, median in self._outlying(values, is_log=is_log):
                reason = f"{name} {values[position]:.4g}{unit}, median {median:.4g}"
                reasons.setdefault(position, []).append(reason)
        for position, reason in self._outlying_states():
            reasons.setdefault(position, []).append(reason)
        if not reasons:
            return []
        uids = {self._uids[position]: reasons[position][0] for position in sorted(reasons)}
        shown = [f"{uid} by {reason}" for uid, reason in list(uids.items())[:SHOWN]]
        what = f"{len(uids)} far from the others: {'; '.join(shown)}"
        advice = f"look at them, and leave out those that do not belong: {deletion(called, list(uids))}"
        return [Finding("note", what, advice, tuple(uids))]

    def _figures(self) -> list[tuple[Floats, str, str, bool]]:
        figures: list[tuple[Floats, str, str, bool]] = [
            (np.array(self._lengths, np.float64), "length", " steps", True)
        ]
        if self._returns:
            figures.append((np.array(self._returns), "return", "", False))
        return figures

    def _outlying(self, values: Floats, *, is_log: bool) -> list[tuple[int, float]]:
        """Return which of the values (E,) are far from those of episodes that end alike, and their median."""
        found = []
        for end in sorted(set(self._ends)):
            members = np.array([position for position, other in enumerate(self._ends) if other == end])
            group = np.log(values[members]) if is_log else values[members]
            median = float(np.median(group))
            floor = _SMALLEST_SCALE * (1.0 if is_log else abs(median))
            far = np.abs(group - median) > OUTLYING * np.maximum(_spread(group), floor)
            if len(members) >= FEWEST:
                shown = float(np.median(values[members]))
                found += [(int(position), shown) for position in members[far]]
        return found

    def _outlying_states(self) -> Iterator[tuple[int, str]]:
        """Yield which episodes leave the range of the others by more than its width, and how."""
        if self._column is None or len(self._uids) < FEWEST:
            return
        extremes = np.array(self._extremes)
        median = np.median(extremes, axis=0)
        low = np.quantile(extremes[:, 0], 1 - INLYING, axis=0, method="higher")
        high = np.quantile(extremes[:, 1], INLYING, axis=0, method="lower")
        outside = np.stack([low - extremes[:, 0], extremes[:, 1] - high], axis=1)
        far = (outside > high - low) & (np.abs(extremes - median) > OUTLYING * _spread(extremes))
        # A value that is constant in the others has no width to compare with.
        far &= high > low
        for position, side, index in np.argwhere(far).tolist():
            reached = extremes[position, side, index]
            name = channels(self._column, [index])
            yield position, f"{name}, which reaches {reached:.4g}, median {median[side, index]:.4g}"


def _spread(values: Floats) -> Floats:
    """Return the robust standard deviation over the first axis, by the median absolute deviation."""
    spread: Floats = _TO_STD * np.median(np.abs(values - np.median(values, axis=0)), axis=0)
    return spread
