"""Cut a recording into episodes."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from astra_data.core.errors import BadInputError
from astra_data.core.wording import first_few
from astra_data.dataset.checkup.clock import Clock
from astra_data.dataset.checkup.jumps import full_turns, shortest
from astra_data.dataset.columns import (
    DONE,
    NEXT_STATE,
    REWARD,
    STATE,
    SUCCESS,
    TERMINATED,
    TRUNCATED,
    Array,
    Column,
    Scalar,
)
from astra_data.dataset.endings import is_terminated
from astra_data.exchange.conversion import Converter, Mask
from astra_data.exchange.mapping import ImportMapping
from astra_data.exchange.recording import Block
from astra_data.exchange.tally import Tally

REASONS = ("file", "source", "field", "end", "gap", "back", "jump", "rejected")
"""Why a new episode begins, the first that applies: a new file, the format's own episodes, a field that
changes, a flag in the row before (next.terminated and next.truncated too), a gap in time, time that goes
back, a jump, rows that were rejected."""

RATE_TOLERANCE = 0.1
"""Largest relative difference between fps and the rate measured from the times."""
_ENOUGH = 20
"""Steps of a file of which its rate can be told."""

Cut = tuple[dict[str, Array], dict[str, Scalar]]


class Cutter:
    """Cuts consecutive blocks into episodes; holds one episode in memory at a time.

    Attributes:
        tally: of the rows so far.
    """

    def __init__(self, mapping: ImportMapping) -> None:
        """Cut by `mapping`."""
        self.tally = Tally()
        self._mapping = mapping
        self._converter = Converter(mapping)
        self._before: dict[str, Array] = {}
        self._kept_before: tuple[Array, Array | None] | None = None
        self._counters: NDArray[np.int64] = np.zeros(len(REASONS) - 1, np.int64)
        self._pieces: list[dict[str, Array]] = []
        self._metadata: dict[str, Scalar] = {}
        self._ended = False
        self._spent: list[tuple[str, NDArray[np.float64]]] = []
        self._clock = Clock(mapping.time or "", mapping.fps)

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of the episodes; known after the first block."""
        return self._converter.columns

    def feed(self, block: Block, row: int, *, is_apart: bool) -> Iterator[Cut]:
        """Add `block`; yield the columns and the metadata of the episodes that ended.

        Args:
            block: at least one row.
            row: number of its first row in its file.
            is_apart: whether it begins a new file instead of continuing the block before.

        Raises:
            BadInputError: values do not fit their columns, or change in size; lists every fault.
        """
        columns, finite = self._converter.convert(block)
        self.tally.rows += len(block)
        used = {*self._mapping.all_fields, *self.tally.unused_fields}
        self.tally.unused_fields += [name for name in block.known if name not in used]
        for note in block.notes:
            self.tally.topics.setdefault(note.removeprefix(f"{block.origin}: "), []).append(block.origin)
        if is_apart or not self._spent or self._spent[-1][0] != block.origin:
            self._spent.append((block.origin, np.zeros(3)))
        rejected = ~finite
        if rejected.any():
            first = int(np.argmax(rejected))
            self.tally.rejected_first = self.tally.rejected_first or block.place(first, row + first)
            self.tally.rejected_rows += int(rejected.sum())
        if block.torn:
            self.tally.count_torn(block.torn, block.row_name(row + len(block)))
        counters = self._count(block, row, columns, rejected, is_apart=is_apart)
        self._keep_ends(columns, counters[:-1], finite)
        if not finite.any():
            return
        kept = {name: values[finite] for name, values in columns.items()}
        begins, is_new = self._begins(counters[:, finite], kept)
        rows = row + np.flatnonzero(finite)
        edges = [0, *np.flatnonzero(begins).tolist(), len(begins)]
        for first, last in pairwise(edges):
            if begins[first] and first < last:
                yield from self.finish()
                self._ended &= not is_new[first]
                self._metadata = {"source": block.origin, "source_row": int(rows[first])}
            if first < last:
                self._pieces.append({name: values[first:last] for name, values in kept.items()})

    def _keep_ends(self, columns: dict[str, Array], counters: NDArray[np.int64], finite: Mask) -> None:
        """Where a rejected row ends an episode or succeeds, let the last row that is kept of it do so.

        `counters` are those of all reasons but rejected rows.
        """
        flags = [columns[name] for name in (TERMINATED, SUCCESS) if name in columns]
        if not flags:
            return
        kept_before = np.maximum.accumulate(np.where(finite, np.arange(len(finite)), -1))
        for row in np.flatnonzero(~finite & np.any(flags, axis=0)):
            last, at, then = columns, kept_before[row], counters[:, kept_before[row]]
            if at < 0:
                if self._kept_before is None:
                    continue
                last, then = self._pieces[-1], self._kept_before[0][:-1, 0]
            if (then == counters[:, row]).all():
                for name in {TERMINATED, SUCCESS} & columns.keys():
                    last[name][at] |= columns[name][row]

    def finish(self) -> Iterator[Cut]:
        """Yield the current episode, if there is one, and begin the next."""
        if not self._pieces:
            return
        episode = {name: np.concatenate([piece[name] for piece in self._pieces]) for name in self._pieces[0]}
        self._pieces = []
        ended_before, self._ended = self._ended, is_terminated(episode)
        if ended_before and self._ended and len(episode[TERMINATED]) == 1 and NEXT_STATE not in episode:
            self.tally.rows_after_end += 1
            return
        if STATE in episode and NEXT_STATE not in episode:
            episode = self._with_next_states(episode)
        length = len(next(iter(episode.values())))
        if length < self._mapping.min_steps:
            self.tally.short_rows += length
            return
        terminated = episode.setdefault(TERMINATED, np.zeros(length, bool))
        truncated = episode.get(TRUNCATED, np.zeros(length, bool)).copy()
        truncated[-1] |= not terminated[-1]
        episode |= {TRUNCATED: truncated, DONE: terminated | truncated}
        self.tally.endings.add(episode)
        if REWARD in episode:
            self._metadata["return"] = float(episode[REWARD].sum(dtype=np.float64))
        yield episode, self._metadata

    def _with_next_states(self, episode: dict[str, Array]) -> dict[str, Array]:
        """Add the state of the next row to each row, and drop the last or let it stand still."""
        state = episode[STATE]
        terminated = is_terminated(episode)
        if terminated and self._mapping.terminal == "stand_still":
            return episode | {NEXT_STATE: np.concatenate([state[1:], state[-1:]])}
        self.tally.last_rows += 1
        self.tally.last_terminated += terminated
        kept = {name: values[:-1].copy() for name, values in episode.items()}
        steps = len(state) - 1
        if steps and SUCCESS in kept:
            # The row's state is the one that the step before leads to.
            kept[SUCCESS][-1] = episode[SUCCESS][-1] or (kept[SUCCESS][-1] and not terminated)
        if steps and terminated:
            kept[TERMINATED][-1] = True
        if REWARD in kept and steps and terminated:
            kept[REWARD][-1] += episode[REWARD][-1]
        elif REWARD in kept:
            self.tally.last_reward += float(episode[REWARD][-1])
        return kept | {NEXT_STATE: state[1:]}

    def check(self) -> None:
        """Compare fps to the rates measured from the times; tally these, and which steps float32 rounds.

        The rates are the mean rate, and the usual one without pauses, of all files and of each, or of each
        episode of formats that have their own.

        Raises:
            BadInputError: most steps of large numbers are lost; or both rates differ by more than
                `RATE_TOLERANCE` over all files; names those that differ.
        """
        self.tally.notes += self._converter.rounded()
        origins = [origin for origin, spent in self._spent if spent.any()]
        if not origins:
            return
        fps, spent = self._mapping.fps, np.array([spent for _, spent in self._spent if spent.any()])
        rates = spent[:, 2:] / spent[:, :2]
        off = (np.abs(rates / fps - 1) > RATE_TOLERANCE).all(axis=1) & (spent[:, 2] >= _ENOUGH)
        named = [f"{origin}: {rates[at, 1]:.4g} Hz" for at, origin in enumerate(origins) if off[at]]
        seconds, usual_seconds, steps = spent.sum(axis=0)
        pooled = steps / seconds, steps / usual_seconds
        if all(abs(rate / fps - 1) > RATE_TOLERANCE for rate in pooled):
            advice = "correct fps or time_scale, or resample the recording"
            if self.tally.back_rows:
                advice += (
                    f"; time goes back in {self.tally.back_rows} rows, first in {self.tally.back_first}: "
                    "sort them if they belong together"
                )
            if named and len(origins) > 1:
                advice += f"; {first_few(named, 8)}"
            raise BadInputError(
                f"'{self._mapping.time}' gives {pooled[0]:.4g} rows per second, but fps is {fps}: {advice}"
            )
        self.tally.notes += [f"{name}, {fps} Hz declared" for name in named]
        self.tally.clock = str(self._clock)

    def _count(
        self, block: Block, row: int, columns: dict[str, Array], rejected: Mask, *, is_apart: bool
    ) -> NDArray[np.int64]:
        """Return how often each reason, except jumps, has applied up to each row, (reasons, n)."""
        split, n = self._mapping.split, len(block)
        masks: dict[str, Mask] = {reason: np.zeros(n, bool) for reason in REASONS if reason != "jump"}
        fields = {name: np.asarray(values).reshape(n, -1) for name, values in block.values.items()}
        now: dict[str, Array] = {f"ends {name}": fields[name] for name in split.ends}
        now |= {name: columns[name][:, None] for name in (TERMINATED, TRUNCATED) if name in columns}
        if split.field:
            now["field"] = fields[split.field]
        if self._mapping.time:
            recorded = fields[self._mapping.time][:, :1].astype(np.float64) * self._mapping.time_scale
            # As they are, held over rows without a time, and over those that are dropped.
            now["gap"] = np.repeat(recorded, 3, axis=1)
            if self._mapping.not_finite == "drop":
                now["gap"][rejected, 2] = np.nan
        continues = not (is_apart or block.starts)
        for key, values in now.items():
            before = self._before[key] if continues else values[:1]
            if before.shape[1:] != values.shape[1:]:
                sizes = f"{values.shape[1]} values, before there were {before.shape[1]}"
                raise BadInputError(f"{block.origin}: split.{key} has {sizes}")
            series = np.concatenate([before, values])
            if key == "field":
                earlier, later = series[:-1], series[1:]
                # What is missing (NaN) is the same value again, as empty cells of CSV are.
                are_missing = (earlier != earlier) & (later != later)
                masks[key] = ((earlier != later) & ~are_missing).any(axis=1)
            elif key == "gap":
                series[:, 1:] = _held(series[:, 1:])
                steps_s, kept_s = np.diff(series[:, 1:], axis=0).T
                masks["back"], masks[key] = steps_s < 0, self._gaps(steps_s, kept_s)
                known = np.isfinite(series[:, 0])
                stands = (steps_s == 0) & known[:-1] & known[1:]
                stands[0] &= continues
                self.tally.count_times(masks["back"], stands, lambda at: block.row_name(row + at))
                now[key] = series[1:]
            else:
                masks["end"] |= (np.nan_to_num(series[:-1]) != 0).any(axis=1)
        masks["file"][0], masks["source"][0] = is_apart, block.starts and not block.is_back
        masks["back"][0] |= block.is_back
        self._before = {key: values[-1:] for key, values in now.items()}
        if self._mapping.not_finite == "split":
            masks["rejected"] = rejected
        counters: NDArray[np.int64] = self._counters[:, None] + np.cumsum(list(masks.values()), axis=1)
        self._counters = counters[:, -1].copy()
        if self._mapping.not_finite != "drop":
            self._counters[-1] += block.torn
        return counters

    def _gaps(self, steps_s: Array, kept_s: Array) -> Mask:
        """Return which steps in time (n,), of all rows or of those that are kept, are longer than `gap_s`.

        The others of those that are kept, and that go on, are measured: the seconds that they took, those
        that they would have taken if all were as long as the median, and how many they are.
        """
        longest = self._mapping.split.gap_s
        gaps = np.zeros(len(steps_s), bool) if longest is None else (steps_s > longest) | (kept_s > longest)
        regular = kept_s[~gaps & (kept_s > 0)]
        if len(regular):
            measured = np.array([regular.sum(), np.median(regular) * len(regular), len(regular)])
            self._spent[-1][1][:] += measured
            self._clock.count(regular)
        return gaps

    def _begins(self, counters: NDArray[np.int64], kept: dict[str, Array]) -> tuple[Mask, Mask]:
        """Return which of the kept rows begin an episode, and which a file, a source or a field's value.

        The reasons are counted.
        """
        jump = self._mapping.split.jump
        where = kept[jump.column].reshape(counters.shape[1], -1)[:, list(jump.values)] if jump else None
        if self._kept_before is None:
            old_counters, old_where = counters[:, :1], None if where is None else where[:1]
        else:
            old_counters, old_where = self._kept_before
        changed = np.diff(np.concatenate([old_counters, counters], axis=1), axis=1) > 0
        jumped = np.zeros(counters.shape[1], bool)
        if jump and where is not None and old_where is not None:
            [column] = (column for column in self.columns if column.name == jump.column)
            steps = np.diff(np.concatenate([old_where, where]).astype(np.float64), axis=0)
            steps = shortest(steps, full_turns(column)[list(jump.values)])
            jumped = np.linalg.norm(steps, axis=1) > jump.above
        reasons = np.insert(changed, REASONS.index("jump"), jumped, axis=0)
        begins: Mask = np.asarray(reasons.any(axis=0))
        for reason in np.argmax(reasons[:, begins], axis=0):
            name = REASONS[reason]
            self.tally.split_points[name] = self.tally.split_points.get(name, 0) + 1
        begins[0] |= self._kept_before is None
        self._kept_before = counters[:, -1:], None if where is None else where[-1:]
        is_new: Mask = np.asarray(reasons[: REASONS.index("end")].any(axis=0))
        return begins, is_new


def _held(times: Array) -> Array:
    """Replace values of `times` (n, k) that are not finite by the last finite one, so that gaps are seen."""
    rows = np.where(np.isfinite(times), np.arange(len(times))[:, None], 0)
    held: Array = np.take_along_axis(times, np.maximum.accumulate(rows, axis=0), axis=0)
    return held
