"""The declared rate against recorded times: gaps, jitter, clocks that stand still."""

import re
from typing import Self

import numpy as np

from astra_data.core.arrays import Floats
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
"""Shares of a period, and `MOST_PERIODS` of them, beyond which a step is in another unit than is thought."""
MOST_PERIODS = 100
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}


def is_clock(column: Column) -> bool:
    """Return whether a column holds times: one number, and a name that ends in time, stamp or timestamp."""
    named = re.fullmatch(r"(.*[._/])?(time|stamp|timestamp)(_(s|ms|us|ns))?", column.name.lower())
    return column.size == 1 and column.dtype != "bool" and column.name not in RESERVED and named is not None


class Clock:
    """The times that are called `name`, in `scale` s, of a recording of `fps` declared steps per second."""

    def __init__(self, name: str, fps: int, scale: float = 1.0, *, whole: bool = False) -> None:
        self._name, self._fps, self._scale, self._whole = name, fps, scale, whole
        self._steps_s: list[Floats] = []
        self._uids: list[int] = []

    @classmethod
    def of(cls, column: Column, fps: int) -> Self:
        """Return a clock of the times in `column` (T,), in its unit, by default s."""
        unit = column.units[0] or column.name.lower().rpartition("_")[2]
        return cls(column.name, fps, _SECONDS.get(unit, 1.0), whole=column.dtype == "int64")

    def add(self, episode: Episode) -> None:
        """Count the steps between the times of the next episode."""
        self.count(np.diff(episode.columns[self._name].astype(np.float64)) * self._scale, episode.uid)

    def count(self, steps_s: Floats, uid: int = 0) -> None:
        """Count steps of the episode `uid`, (n,) in s."""
        self._steps_s.append(steps_s)
        self._uids.append(uid)

    def _sorted_steps(self) -> Floats:
        """Return the steps in which time goes on, in s, the shortest first."""
        steps_s = np.concatenate([*self._steps_s, np.zeros(0)])
        return np.sort(steps_s[steps_s > 0])

    @property
    def period_s(self) -> float:
        """The mean in s of the `INNER` share of steps around the median; 0 without steps."""
        steps_s = self._sorted_steps()
        first, last = (int(len(steps_s) * share) for share in ((1 - INNER) / 2, (1 + INNER) / 2))
        return float(steps_s[first : max(last, first + 1)].mean()) if len(steps_s) else 0.0

    @property
    def gaps(self) -> int:
        """Steps that took over `GAP` periods."""
        return int((self._sorted_steps() > GAP * self.period_s).sum())

    @property
    def jitter(self) -> float:
        """Periods by which 5 % of the steps are off at least, gaps aside."""
        steps_s, period_s = self._sorted_steps(), self.period_s
        offsets = np.abs(steps_s[steps_s <= GAP * period_s] - period_s)
        return float(np.quantile(offsets, INNER) / period_s) if len(offsets) else 0.0

    def __str__(self) -> str:
        """Compare the rates."""
        declared, period_s = f"{self._fps} Hz declared", self.period_s
        if not self._has_rate:
            return f"{declared}; {self._name} does not increase in most steps"
        if off := self._off:
            return f"{declared}, and {off} by {self._name}"
        share = self.gaps / len(self._sorted_steps())
        missing = f" ({100 * share:.0f} % of the steps: rows are missing)" if share >= MANY_GAPS else ""
        return (
            f"{declared}, {1 / period_s:.4g} Hz by {self._name}; gaps within episodes: {self.gaps}{missing}, "
            f"jitter {100 * self.jitter:.1f} % of a period"
        )

    def findings(self, called: str) -> list[Finding]:
        """Tell a wrong rate, gaps, jitter, and where time stands still or goes back."""
        found, period_s = [], self.period_s
        if standing := [
            u for u, steps_s in zip(self._uids, self._steps_s, strict=True) if (steps_s <= 0).any()
        ]:
            what = f"{self._name} stands still or goes back between steps"
            remedy = "store it as seconds since the start (`offset`) or as int64"
            if self._whole:
                remedy = (
                    "look for duplicate rows in the log or a clock that was set back, and in MCAP for an "
                    "`fps` that is too high or a topic that drops out (`gap_s`)"
                )
            advice = f"{remedy}, or leave the episodes out: {deletion(called, standing)}"
            found.append(Finding("warning", what, advice, tuple(standing)))
        if not self._has_rate:
            return found
        if off := self._off:
            advice = "give its `unit` (s, ms, us or ns) or correct `fps` in the mapping, and import again"
            return [*found, Finding("warning", f"{off}, by {self._name}", advice)]
        if abs(1 / period_s / self._fps - 1) > WRONG_RATE:
            what = f"{self._name} runs at {1 / period_s:.4g} Hz, but {self._fps} Hz is declared"
            advice = "correct `fps` in the mapping, or resample, and import again"
            found.append(Finding("warning", what, advice))
        if self.gaps:
            longest = [float(steps_s.max(initial=0.0)) for steps_s in self._steps_s]
            uids = [uid for uid, s in zip(self._uids, longest, strict=True) if s > GAP * period_s]
            what = f"steps of over {GAP:g} periods: {self.gaps}, the longest {max(longest):.3g} s"
            remedy = (
                f"begin new episodes there (`time`, and `gap_s = {GAP * period_s:.3g}` in [split], of the "
                f'mapping; for MCAP, `gap_s = {HELD * period_s:.3g}` in [columns."{self._name}"])'
            )
            # Many gaps are a recording of another rate, of which splits would leave crumbs.
            if self.gaps >= MANY_GAPS * len(self._sorted_steps()):
                remedy = f"resample the recording (of MCAP, take an `fps` that divides its rate), or {remedy}"
            found.append(Finding("warning", what, f"{remedy} and import again", tuple(uids)))
        if self.jitter > JITTERY:
            off = f"{100 * self.jitter:.0f} %"
            what = f"5 % of the steps are off by {off} of a period or more, by {self._name}"
            advice = f"resample the recording to {self._fps} Hz and import again"
            found.append(Finding("note", what, advice))
        return found

    @property
    def _has_rate(self) -> bool:
        """Whether time goes on in most steps: float32 cannot hold the seconds since 1970, for one."""
        return 2 * len(self._sorted_steps()) > sum(map(len, self._steps_s))

    @property
    def _off(self) -> str:
        """How long a step is, if it is so long or short that the unit is another than is thought."""
        periods = self.period_s * self._fps
        if 1 / FINE <= periods < MOST_PERIODS:
            return ""
        return "a step takes " + (
            f"1/{FINE} of a period or less" if periods < 1 else f"{MOST_PERIODS} periods or more"
        )
