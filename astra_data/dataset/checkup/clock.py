"""The declared rate against recorded times: gaps, jitter, clocks that stand still."""

import re
from typing import Self

import numpy as np
from numpy.typing import NDArray

from astra_data.dataset.checkup.findings import Finding, deletion
from astra_data.dataset.columns import RESERVED, Column, Episode

GAP = 1.5
"""A step that takes more than so many periods is a gap."""
HELD = 0.75
"""Periods for which an MCAP topic may be held, as is proposed: rows that lack a message hold one longer."""
WRONG_RATE = 0.05
"""Relative difference between the declared and the recorded rate above which the declared one is wrong."""
JITTERY = 0.2
"""Periods by which 5 % of the steps are off at least in a jittery recording."""
MANY_GAPS = 0.01
"""Share of the steps from which on gaps are many."""
INNER = 0.95
"""Share of the steps that the rate and the jitter are of."""
FINE = 1000
"""Bins of a period."""
MOST_PERIODS = 100
"""Longer steps are counted as so long."""
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}


def is_clock(column: Column) -> bool:
    """Return whether a column holds times: one number, and a name that ends in time, stamp or timestamp."""
    named = re.fullmatch(r"(.*[._/])?(time|stamp|timestamp)(_(s|ms|us|ns))?", column.name.lower())
    return column.size == 1 and column.dtype != "bool" and column.name not in RESERVED and named is not None


class Clock:
    """The times that are called `name`, in `scale` s, of a recording of `fps` declared steps per second."""

    def __init__(self, name: str, fps: int, scale: float = 1.0, *, whole: bool = False) -> None:
        self._name, self._fps, self._scale, self._whole = name, fps, scale, whole
        self._bins: NDArray[np.int64] = np.zeros(FINE * MOST_PERIODS + 1, np.int64)
        self._longest_s: list[float] = []
        self._standing: list[int] = []
        self._standing_steps = 0
        self._uids: list[int] = []

    @classmethod
    def of(cls, column: Column, fps: int) -> Self:
        """Return a clock of the times in `column` (T,), in its unit, by default s."""
        unit = column.units[0] or column.name.lower().rpartition("_")[2]
        return cls(column.name, fps, _SECONDS.get(unit, 1.0), whole=column.dtype == "int64")

    def add(self, episode: Episode) -> None:
        """Count the steps between the times of the next episode."""
        self.count(np.diff(episode.columns[self._name].astype(np.float64)) * self._scale, episode.uid)

    def count(self, steps_s: NDArray[np.float64], uid: int = 0) -> None:
        """Count steps of the episode `uid`, (n,) in s."""
        goes_on = steps_s[steps_s > 0]
        bins = np.rint(goes_on * self._fps * FINE).clip(0, FINE * MOST_PERIODS).astype(np.int64)
        self._bins += np.bincount(bins, minlength=len(self._bins))
        self._uids.append(uid)
        self._longest_s.append(float(goes_on.max(initial=0.0)))
        if len(goes_on) < len(steps_s):
            self._standing.append(uid)
            self._standing_steps += len(steps_s) - len(goes_on)

    @property
    def period_s(self) -> float:
        """The usual step in s; 0 if time never goes on."""
        return self._period() / (FINE * self._fps)

    @property
    def gaps(self) -> int:
        """Steps that took over `GAP` periods."""
        return int(self._bins[self._first_gap() :].sum())

    @property
    def jitter(self) -> float:
        """Periods by which 5 % of the steps are off at least, gaps aside."""
        period = self._period()
        if not period:
            return 0.0
        offsets = np.rint(np.abs(np.arange(self._first_gap()) - period)).astype(np.int64)
        counts = np.bincount(offsets, weights=self._bins[: self._first_gap()])
        return _quantile(counts.astype(np.int64), INNER) / period

    def __str__(self) -> str:
        """Compare the rates."""
        if not self._has_rate:
            return f"{self._fps} Hz declared; {self._name} does not increase in most steps"
        if self._is_off:
            return f"{self._fps} Hz declared, and {self._off} by {self._name}"
        share, rate = self.gaps / int(self._bins.sum()), f"{1 / self.period_s:.4g} Hz by {self._name}"
        missing = f" ({100 * share:.0f} % of the steps: rows are missing)" if share >= MANY_GAPS else ""
        jitter = f"jitter {100 * self.jitter:.1f} % of a period"
        return f"{self._fps} Hz declared, {rate}; gaps within episodes: {self.gaps}{missing}, {jitter}"

    def findings(self, called: str) -> list[Finding]:
        """Tell a wrong rate, gaps, jitter, and where time stands still or goes back."""
        found = []
        period_s = self.period_s
        if self._standing:
            what = f"{self._name} stands still or goes back between steps"
            remedy = "store it as seconds since the start (`offset`) or as int64"
            if self._whole:
                remedy = (
                    "look for duplicate rows in the log or a clock that was set back, and in MCAP for an "
                    "`fps` that is too high or a topic that drops out (`gap_s`)"
                )
            advice = f"{remedy}, or leave the episodes out: {deletion(called, self._standing)}"
            found.append(Finding("warning", what, advice, tuple(self._standing)))
        if not self._has_rate:
            return found
        if self._is_off:
            advice = "give its `unit` (s, ms, us or ns) or correct `fps` in the mapping, and import again"
            return [*found, Finding("warning", f"{self._off}, by {self._name}", advice)]
        if abs(1 / period_s / self._fps - 1) > WRONG_RATE:
            found.append(
                Finding(
                    "warning",
                    f"{self._name} runs at {1 / period_s:.4g} Hz, but {self._fps} Hz is declared",
                    "correct `fps` in the mapping, or resample, and import again",
                )
            )
        if self.gaps:
            longest = np.array(self._longest_s)
            uids = np.array(self._uids)[longest * self._fps * FINE >= self._first_gap() - 0.5]
            advice = self._gap_remedy()
            what = f"steps of over {GAP:g} periods: {self.gaps}, the longest {longest.max():.3g} s"
            found.append(Finding("warning", what, f"{advice} and import again", tuple(uids.tolist())))
        if self.jitter > JITTERY:
            off = f"{100 * self.jitter:.0f} %"
            what = f"5 % of the steps are off by {off} of a period or more, by {self._name}"
            advice = f"resample the recording to {self._fps} Hz and import again"
            found.append(Finding("note", what, advice))
        return found

    def _gap_remedy(self) -> str:
        remedy = (
            f"begin new episodes there (`time`, and `gap_s = {GAP * self.period_s:.3g}` in [split], of the "
            f'mapping; for MCAP, `gap_s = {HELD * self.period_s:.3g}` in [columns."{self._name}"])'
        )
        # Many gaps are a recording of another rate, of which splits would leave crumbs.
        if self.gaps < MANY_GAPS * self._bins.sum():
            return remedy
        return f"resample the recording (of MCAP, take an `fps` that divides its rate), or {remedy}"

    @property
    def _has_rate(self) -> bool:
        """Whether time goes on in most steps: float32 cannot hold the seconds since 1970, for one."""
        return bool(self._bins.sum() > self._standing_steps)

    @property
    def _is_off(self) -> bool:
        """Whether steps are so long or short that the times are in another unit than is thought."""
        return not 1.0 <= self._period() <= FINE * (MOST_PERIODS - 1)

    @property
    def _off(self) -> str:
        """How long a step is, if it is so long or short."""
        few = f"1/{FINE} of a period or less"
        return f"a step takes {few if self._period() < FINE else f'{MOST_PERIODS} periods or more'}"

    def _period(self) -> float:
        """The mean over the `INNER` share of steps around the median, in bins: gaps do not move it."""
        low, high = (_quantile(self._bins, share) for share in ((1 - INNER) / 2, (1 + INNER) / 2))
        inner = self._bins[low : high + 1]
        return float(np.arange(low, high + 1) @ inner / inner.sum()) if inner.sum() else 0.0

    def _first_gap(self) -> int:
        return min(int(GAP * self._period()) + 1, len(self._bins))


def _quantile(counts: NDArray[np.int64], share: float) -> int:
    """Return the first index up to which `share` of the `counts` lie; 0 if there are none."""
    total = np.cumsum(counts)
    return int(np.searchsorted(total, share * total[-1])) if total[-1] else 0
