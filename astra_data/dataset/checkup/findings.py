"""One thing that a check-up found, where, and what to do about it."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, Self

import numpy as np

from astra_data.core.arrays import Floats, as_rows
from astra_data.core.naming import first_few
from astra_data.dataset.columns import NEXT_STATE, RESERVED, STATE, Column, Episode

SHOWN = 5  # episodes that a line names; further ones are counted
ANGLE = re.compile(r"(.+_)?(heading|yaw|theta|psi|roll|pitch|angle|q\d*|joint\d*)")  # names of angles
TURNS = {"rad": 2 * math.pi, "deg": 360.0}  # what a full turn is in each unit
LARGEST = 4 * math.pi  # few robots turn further than twice around


@dataclass(frozen=True)
class Finding:
    """What was found, and what to do about it."""

    severity: Literal["warning", "note"]
    """A warning if a grounding would be fitted to something that the robot did not do."""
    what: str
    advice: str
    episodes: tuple[int, ...] = ()  # uids of the episodes where it is; empty if it concerns the whole dataset

    def __str__(self) -> str:
        """Say it in a line."""
        word = "episode" if len(self.episodes) == 1 else "episodes"
        where = f" ({word} {first_few(self.episodes, SHOWN)})" if self.episodes else ""
        return f"{self.severity}: {self.what}{where}: {self.advice}"

    def record(self) -> dict[str, Any]:
        """Return it for JSON, with all its episodes."""
        return asdict(self) | {"episodes": list(self.episodes)}


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


def full_turns(column: Column) -> Floats:
    """Return what a full turn adds to each value of a column, (size,); 0 for values that are no angles."""
    roles = (column.astra or {}).get("role", [""] * column.size)
    radians = [2 * np.pi if role == "heading" else 0.0 for role in roles]
    return np.array([TURNS.get(unit, turn) for unit, turn in zip(column.units, radians, strict=True)])


def shortest(steps: Floats, turns: Floats) -> Floats:
    """Return `steps` (T, S) less whole `turns` (S,), where these are not 0."""
    left: Floats = steps - turns * np.rint(np.divide(steps, turns, out=np.zeros_like(steps), where=turns > 0))
    return left


def continuity(episodes: Iterable[Episode]) -> list[Finding]:
    """Tell of how many steps the next state is not the state of the row after it, to the bit."""
    steps, broken = 0, dict[int, int]()
    for episode in episodes:
        state, arrived = as_rows(episode.columns[STATE]), as_rows(episode.columns[NEXT_STATE])
        steps += len(state) - 1
        broken[episode.uid] = int((arrived[:-1] != state[1:]).any(axis=1).sum())
    uids = tuple(uid for uid, count in broken.items() if count)
    what = f"steps whose {NEXT_STATE} is not the state of the next row: {sum(broken.values())} of {steps}"
    advice = (
        "rows are missing, or the columns come from different logs: import again, without "
        f"{NEXT_STATE} in the mapping if each row is the state after the one before"
    )
    return [Finding("warning", what, advice, uids)] if uids else []


GAP = 1.5  # a step that takes more than so many periods is a gap
HELD = 0.75  # periods for which an MCAP topic may be held, as is proposed: rows that lack a message hold one longer
WRONG_RATE = 0.05
"""Relative difference between the declared and the recorded rate above which the declared one is wrong."""
JITTERY = 0.2  # periods by which 5 % of the steps are off at least in a jittery recording
MANY_GAPS = 0.01  # share of the steps from which on gaps are many
INNER = 0.95  # share of the steps that the rate and the jitter are of
FINE = 1000  # shares of a period, and `MOST_PERIODS` of them, beyond which a step is in another unit than is thought
MOST_PERIODS = 100
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

    @classmethod
    def of(cls, column: Column, fps: int) -> Self:
        """Return a clock of the times in `column` (T,), in its unit, by default s."""
        unit = column.units[0] or column.name.lower().rpartition("_")[2]
        return cls(column.name, fps, _SECONDS.get(unit, 1.0), column.dtype == "int64")

    def add(self, episode: Episode) -> None:
        """Count the steps between the times of the next episode."""
        self.count(np.diff(episode.columns[self.name].astype(np.float64)) * self.scale, episode.uid)

    def count(self, steps_s: Floats, uid: int = 0) -> None:
        """Count steps of the episode `uid`, (n,) in s."""
        self.steps_s.append(steps_s)
        self.uids.append(uid)

    def rates(self) -> tuple[float, int, float, float]:
        """Return period in s, number of gaps, their share of the steps, and jitter in periods; 0 without a rate.

        The period is the mean of the `INNER` share of steps around the median; by the jitter, 5 % of the steps
        are off at least, gaps aside. Time goes on in most steps, or there is no rate: float32 cannot hold the
        seconds since 1970, for one.
        """
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
        """Compare the rates."""
        declared, (period_s, gaps, share, jitter) = f"{self.fps} Hz declared", self.rates()
        if not period_s:
            return f"{declared}; {self.name} does not increase in most steps"
        if off := self._off(period_s):
            return f"{declared}, and {off} by {self.name}"
        missing = f" ({100 * share:.0f} % of the steps: rows are missing)" if share >= MANY_GAPS else ""
        return (
            f"{declared}, {1 / period_s:.4g} Hz by {self.name}; gaps within episodes: {gaps}{missing}, "
            f"jitter {100 * jitter:.1f} % of a period"
        )

    def findings(self, called: str) -> list[Finding]:
        """Tell a wrong rate, gaps, jitter, and where time stands still or goes back."""
        found, (period_s, gaps, share, jitter) = [], self.rates()
        if standing := [u for u, steps_s in zip(self.uids, self.steps_s, strict=True) if (steps_s <= 0).any()]:
            remedy = "store it as seconds since the start (`offset`) or as int64"
            if self.is_whole:
                remedy = (
                    "look for duplicate rows in the log or a clock that was set back, and in MCAP for an "
                    "`fps` that is too high or a topic that drops out (`gap_s`)"
                )
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
            remedy = (
                f"begin new episodes there (`time`, and `gap_s = {GAP * period_s:.3g}` in [split], of the "
                f'mapping; for MCAP, `gap_s = {HELD * period_s:.3g}` in [columns."{self.name}"])'
            )
            # Many gaps are a recording of another rate, of which splits would leave crumbs.
            if share >= MANY_GAPS:
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
