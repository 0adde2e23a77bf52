"""Rows at fps of the messages of asynchronous topics.

From the time when every topic has sent a message, a row is taken every 1 / fps seconds, of each topic's last one
(zero-order hold). A topic that is silent for longer than `split.gap_s`, or the `gap_s` of its column, ends the
episode. Where a state comes a whole number of times as often as rows, these are taken midway between its messages
and the commands': jitter changes no row, and a state meets the command that is in force for most of its step.
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from astra_data.core.arrays import Ints
from astra_data.core.errors import BadInputError
from astra_data.dataset.checkup import GAP
from astra_data.dataset.columns import ACTION, STATE
from astra_data.io.cutting import RATE_TOLERANCE
from astra_data.io.mapping import ImportMapping

MOST_HELD_ROWS = 10**6  # most rows in which the same values may be held: five hours at 50 Hz
MOST_UNEVEN = 0.05  # largest share of a topic's rows, steps or messages that are odd without a warning
_WHOLE = 0.005  # relative error of a measured rate that is taken for a whole number
_SMOOTH = 10  # with so many messages a row, or more, one more or less changes a step too little for a warning
_NEAR = 4  # rates of rows that are proposed are up to so many times as high or low as `fps`
_AVERAGED = 20  # messages of a topic over which jitter is averaged; over many more, a rate that is a little off counts


class Resampler:
    """Holds the last messages of all topics and samples rows from them."""

    def __init__(self, mapping: ImportMapping, origin: str, moments: Mapping[str, Ints], of: Mapping[str, str]) -> None:
        """Sample the fields of `mapping` from the file `origin`; `moments` are of topics, `of` names each field's."""
        self._origin, self._fps = origin, mapping.fps
        self.topics: dict[str, list[str]] = {}
        for field in mapping.all_fields:
            self.topics.setdefault(of[field], []).append(field)
        self.times: dict[str, int] = {}  # of the last message of each topic, in ns
        self.silences: Counter[str] = Counter()  # how often a topic ended an episode, silent for too long alone
        self._repeated: Counter[str] = Counter()
        self._skipped: Counter[str] = Counter()
        self._messages: Counter[str] = Counter()
        self._fresh: set[str] = set()
        self._gap_ns: dict[str, int] = {}
        self._has_own_gap: set[str] = set()
        for column in mapping.columns.values():
            gap_ns = round((column.gap_s or mapping.split.gap_s or 0) * 1e9)
            for topic in () if column.latched else {of[field] for field in column.fields}:
                self._gap_ns[topic] = min(gap_ns, self._gap_ns.get(topic, gap_ns))
                self._has_own_gap |= {topic} if column.gap_s else set()
        self._expiring = set(self._gap_ns)
        self._moments = moments
        self._refuse_apart()
        self._periods = usual_periods(self._moments, round((mapping.split.gap_s or 0) * 1e9))
        self._held: dict[str, Any] = {}
        self._start: int | None = None
        self._row = self._rows = self._delay_ns = 0
        often = {topic: _messages_per_row(1e9 / mapping.fps / period) for topic, period in self._periods.items()}
        state = mapping.columns[STATE].fields if STATE in mapping.columns else ()
        states = self._expiring & {of[field] for field in state}
        self._states = [topic for topic in states if often.get(topic)]
        most = max((often[topic] for topic in self._states), default=0)
        self._in_step = [topic for topic in self._expiring if 0 < often.get(topic, 0) <= most]
        self._spacing_ns = 1e9 / mapping.fps / most if most else 0.0
        columns = mapping.columns.items()
        self._observed = {of[f] for n, c in columns if n.startswith("observation") for f in c.fields}
        self._commands = {t: n for n, c in columns if n.startswith(ACTION) for t in map(of.__getitem__, c.fields)}
        self._lossy = self._commands.keys() | {of[field] for field in mapping.flag_fields}

    def rows(self, messages: Iterable[tuple[str, int, Any]]) -> Iterator[tuple[bool, dict[str, Any]]]:
        """Yield whether a row begins an episode, and each topic's message."""
        time = 0
        for topic, time, message in messages:
            # A pause: all topics that are not latched are silent for too long.
            if self._start is not None and len(self._silent(time)) == len(self._expiring):
                yield from self._sampled(self._end(max(self.times[topic] for topic in self._expiring)))
                self._start = None
            yield from self._sampled(time)
            if self._start is not None:
                self._messages[topic] += 1
                self._skipped[topic] += topic in self._fresh
            self._fresh.add(topic)
            self._held[topic], self.times[topic] = message, time
            if self._start is None and self.times.keys() == self.topics.keys() and not self._silent(time):
                self._delay_ns = self._midway(time)
                self._start, self._row = time + self._delay_ns, 0
        if self._start is not None:
            yield from self._sampled(self._end(time))

    def endings(self) -> Iterator[str]:
        """Yield what ended episodes: each topic that was silent alone, and what to do if it should not."""
        for topic, times in self.silences.items():
            key = "gap_s of its column" if topic in self._has_own_gap else "split.gap_s"
            longest = f"{self._gap_ns[topic] / 1e9:g} s ({key})"
            often = f"is silent for over {longest} {times} times while others are not"
            note = f"{self._origin}: {topic} {often}; episodes end there"
            if command := self._commands.get(topic):
                right = "That is right if the robot stops by itself without commands; if it continues with the last one"
                yield f'{note}. {right}, set latched = true in [columns."{command}"], or a longer gap_s'
            else:
                yield f"{note}: set latched = true if it is sent on change, or a longer gap_s"

    def unevenness(self) -> tuple[str, ...]:
        """Return a line for each topic that many rows repeat, or of which many messages are in no row."""
        notes = []
        for topic in sorted(self._expiring & self._periods.keys()):
            rate = 1e9 / self._periods[topic]
            if topic in self._observed and (odd := uneven_steps(topic, rate, self._fps)):
                notes.append(odd)
            elif self._repeated[topic] > MOST_UNEVEN * self._rows or (
                topic in self._lossy and self._skipped[topic] > MOST_UNEVEN * self._messages[topic]
            ):
                repeated = f"{self._repeated[topic]} of {self._rows} rows repeat its message before"
                lost = f"{self._skipped[topic]} of {self._messages[topic]} messages are in no row"
                notes.append(f"{topic} comes {rate:.4g} times a second, fps is {self._fps}: {repeated}, {lost}")
        return tuple(f"{self._origin}: {note}" for note in notes)

    def _sampled(self, time: int) -> Iterator[tuple[bool, dict[str, Any]]]:
        """Yield the rows before `time` that have not been sampled yet."""
        self._refuse_gap(time)
        while self._start is not None:
            moment = self._start + self._row * 10**9 // self._fps
            if moment >= time:
                return
            if silent := self._silent(moment - self._delay_ns):
                self._start = None
                self.silences.update(silent)
                return
            if self._row:
                self._rows += 1
                self._repeated.update(self.topics.keys() - self._fresh)
            self._fresh.clear()
            yield self._row == 0, dict(self._held)
            self._row += 1

    def _midway(self, time: int) -> int:
        """Return how long after `time` the widest gap between the messages that are in step is half over."""
        if not self._states:
            return 0
        phases = []  # how long after `time`, in ns below the spacing, messages of each topic come but for jitter
        for topic in self._in_step:
            first = np.searchsorted(self._moments[topic], self.times[topic])
            moments = self._moments[topic][first : first + _AVERAGED]
            step = self._spacing_ns * max(1, round(self._periods[topic] / self._spacing_ns))
            phase = np.median(moments - time - step * np.arange(len(moments))) % self._spacing_ns
            phases.append(float(phase))
        gaps = pairwise([*sorted(phases), min(phases) + self._spacing_ns])
        before, after = max(gaps, key=lambda gap: gap[1] - gap[0])
        return round((before + after) / 2 % self._spacing_ns)

    def _end(self, time: int) -> int:
        """Return before when the last row is, of an episode whose last message is at `time`."""
        if not self._states:
            return time + 1
        next_state = max(self.times[topic] + round(self._periods[topic]) for topic in self._states)
        return min(next_state, time + round(self._spacing_ns))

    def _refuse_apart(self) -> None:
        if not self.topics.keys() <= self._moments.keys():
            return
        last = max(self.topics, key=lambda topic: self._moments[topic][0])
        first = min(self._expiring, key=lambda topic: int(self._moments[topic][-1]) + self._gap_ns[topic])
        apart_ns = self._moments[last][0] - self._moments[first][-1]
        if apart_ns > self._gap_ns[first]:
            fault = f"{last} begins {apart_ns / 1e9:.4g} s after the last message of {first}"
            why = "their clocks differ, or one of them was not recorded until the end"
            raise BadInputError(f"{self._origin}: {fault}, and no row can have both: {why}")

    def _refuse_gap(self, time: int) -> None:
        if self._start is None:
            return
        moment = self._start + self._row * 10**9 // self._fps
        end = min(time, *(self.times[topic] + self._gap_ns[topic] for topic in self._expiring))
        if (rows := (end - moment) * self._fps // 10**9) > MOST_HELD_ROWS:
            fault = f"nothing new comes between {moment} and {time} ns, which would be {rows} equal rows"
            wanted = f"expected at most {MOST_HELD_ROWS}: a time is wrong, or split.gap_s is too long"
            raise BadInputError(f"{self._origin}: {fault}, {wanted}")

    def _silent(self, time: int) -> list[str]:
        """Return the topics that may not be silent for so long as they were before `time`; all were heard."""
        return [topic for topic in self._expiring if time - self.times[topic] > self._gap_ns[topic]]


def usual_periods(moments: Mapping[str, Ints], gap_ns: int) -> dict[str, float]:
    """Return the mean step of each topic that has two steps or more up to `gap_ns`, without those of lost messages."""
    periods = {}
    for topic, times in moments.items():
        steps = np.diff(np.unique(times))
        steps = steps[steps <= gap_ns]
        if len(steps) > 1:
            usual = steps[steps <= GAP * np.median(steps)]
            periods[topic] = float((usual if 2 * usual.sum() >= steps.sum() else steps).mean())
    return periods


def _messages_per_row(ratio: float) -> int:
    """Return the whole number that `ratio` is about, 1 where its inverse is, else 0."""
    most = max(ratio, 1 / ratio)
    return 0 if abs(most / round(most) - 1) > RATE_TOLERANCE else max(round(ratio), 1)


def uneven_steps(topic: str, rate: float, fps: int) -> str:
    """Return a warning if `fps` is no whole fraction of the `rate` of `topic` in Hz, with better ones."""
    whole = round(rate)
    if whole and abs(rate / whole - 1) < _WHOLE:
        rate = whole
    fewest, share_long = divmod(rate / fps, 1)
    if not 1 <= fewest < _SMOOTH or min(share_long, 1 - share_long) <= MOST_UNEVEN:
        return ""
    short, long = (f"{1000 * messages / rate:.0f}" for messages in (fewest, fewest + 1))
    near = range(math.ceil(fps / _NEAR), min(_NEAR * fps, whole) + 1)
    even = sorted((each for each in near if rate % each == 0), key=lambda each: abs(math.log(each / fps)))
    best = even[:3] or [min(near, key=lambda each: abs(rate / each - round(rate / each)))]
    advice = f"steps of {short} and {long} ms alternate; take {' or '.join(map(str, sorted(best)))}"
    return f"{topic} comes {rate:.4g} times a second, of which {fps} fps is no whole fraction: {advice}"
