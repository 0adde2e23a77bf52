"""One thing that a check-up found, where, and what to do about it."""

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats, as_rows
from astra_data.core.naming import first_few
from astra_data.dataset.columns import NEXT_STATE, RESERVED, STATE, Column, Episode

SHOWN = 5
"""Episodes that a line names; further ones are counted."""
ANGLE = re.compile(r"(.+_)?(heading|yaw|theta|psi|roll|pitch|angle|q\d*|joint\d*)")
"""Names of angles."""
TURNS = {"rad": 2 * math.pi, "deg": 360.0}
"""What a full turn is in each unit."""
LARGEST = 4 * math.pi
"""Few robots turn further than twice around."""


@dataclass(frozen=True)
class Finding:
    """What was found, and what to do about it."""

    severity: Literal["warning", "note"]
    """A warning if a grounding would be fitted to something that the robot did not do."""
    what: str
    advice: str
    episodes: tuple[int, ...] = ()
    """Uids of the episodes where it is; empty if it concerns the whole dataset."""

    def __str__(self) -> str:
        """Say it in a line."""
        where = f" ({listed(self.episodes)})" if self.episodes else ""
        return f"{self.severity}: {self.what}{where}: {self.advice}"

    def record(self) -> dict[str, Any]:
        """Return it for JSON, with all its episodes."""
        return asdict(self) | {"episodes": list(self.episodes)}


def listed(uids: Sequence[int]) -> str:
    """Name the first `SHOWN` of the episodes `uids` and count the others."""
    words = "episode " if len(uids) == 1 else "episodes "
    return words + first_few(uids, SHOWN)


def deletion(called: str, uids: Sequence[int]) -> str:
    """Return the command that leaves `uids` out of the dataset `called`; it spells the first `SHOWN`."""
    options = " ".join(f"--without {uid}" for uid in uids[:SHOWN])
    return f"astra-data filter {called} {options}" + (" ..." if len(uids) > SHOWN else "")


def labels(column: Column) -> list[str]:
    """Return a name for each value of `column`."""
    return [column.name] if column.size == 1 and not column.names else list(column.labels)


def channels(column: Column, indices: Sequence[int]) -> str:
    """Name the values `indices` of `column`: "x, y of observation.state"."""
    if column.size == 1:
        return column.name
    names = labels(column)
    return f"{', '.join(names[index] for index in indices)} of {column.name}"


def is_angle(name: str) -> bool:
    """Return whether `name` is one of an angle, as "base.theta" or "Yaw.pos"."""
    short = re.sub(r"[^a-z0-9]+", "_", name.lower())
    return ANGLE.fullmatch(re.sub(r"_(pos|position|rad|deg)$", "", short)) is not None


class Angles:
    """The values in radians of a column."""

    def __init__(self, column: Column) -> None:
        self._column = column
        self._angles = [index for index, unit in enumerate(column.units) if unit == "rad"]
        self._farthest: NDArray[np.float64] = np.zeros(len(self._angles))

    def add(self, episode: Episode) -> None:
        """Look at the next episode."""
        values = as_rows(episode.columns[self._column.name])[:, self._angles]
        self._farthest = np.maximum(self._farthest, np.abs(values).max(axis=0))

    def findings(self, called: str = "") -> list[Finding]:
        """Tell which angles are larger than `LARGEST`."""
        found = np.flatnonzero(self._farthest > LARGEST).tolist()
        if not found:
            return []
        named = channels(self._column, [self._angles[index] for index in found])
        what = f"{named}: up to {self._farthest[found].max():.4g} rad, which is more than two full turns"
        advice = "if these are degrees, set `scale` to 0.0174533 in the mapping and import again"
        return [Finding("warning", what, advice)]


def full_turns(column: Column) -> Floats:
    """Return what a full turn adds to each value of a column, (size,); 0 for values that are no angles."""
    roles = (column.astra or {}).get("role", [""] * column.size)
    turns = [
        TURNS.get(unit, 2 * np.pi if role == "heading" else 0.0) for unit, role in zip(column.units, roles, strict=True)
    ]
    return np.array(turns)


def shortest(steps: Floats, turns: Floats) -> Floats:
    """Return `steps` (T, S) less whole `turns` (S,), where these are not 0."""
    angles = turns > 0
    whole = np.rint(np.divide(steps, turns, out=np.zeros_like(steps), where=angles))
    left: Floats = steps - turns * whole
    return left


class Continuity:
    """Compares each step's next state with the state of the row after it, to the bit."""

    def __init__(self) -> None:
        self._steps = self._broken = 0
        self._uids: list[int] = []

    def add(self, episode: Episode) -> None:
        """Compare the steps of the next episode."""
        if NEXT_STATE not in episode.columns or STATE not in episode.columns:
            return
        state, arrived = as_rows(episode.columns[STATE]), as_rows(episode.columns[NEXT_STATE])
        broken = int((arrived[:-1] != state[1:]).any(axis=1).sum())
        self._steps += len(state) - 1
        self._broken += broken
        if broken:
            self._uids.append(episode.uid)

    def findings(self, called: str = "") -> list[Finding]:
        """Tell how many steps do not lead to the row after them."""
        if not self._broken:
            return []
        what = f"steps whose {NEXT_STATE} is not the state of the next row: {self._broken} of {self._steps}"
        advice = (
            "rows are missing, or the columns come from different logs: import again, without "
            f"{NEXT_STATE} in the mapping if each row is the state after the one before"
        )
        return [Finding("warning", what, advice, tuple(self._uids))]


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
        if standing := [u for u, steps_s in zip(self._uids, self._steps_s, strict=True) if (steps_s <= 0).any()]:
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
        return "a step takes " + (f"1/{FINE} of a period or less" if periods < 1 else f"{MOST_PERIODS} periods or more")
