"""Cut recordings into episodes.

Rows are gathered until an episode has ended for sure, and cut with whole arrays: at most an episode and a
block are held, or as much again.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import as_rows
from astra_data.core.errors import BadInputError
from astra_data.core.naming import first_few
from astra_data.dataset.checkup.clock import Clock
from astra_data.dataset.checkup.findings import full_turns, shortest
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
from astra_data.dataset.inspection import is_terminated
from astra_data.io.conversion import Converter, Mask
from astra_data.io.import_report import Tally
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import BLOCK_ROWS, Block

REASONS = ("file", "source", "field", "end", "gap", "back", "jump", "rejected")
"""Why a new episode begins, the first that applies: a new file, the format's own episodes, a field that
changes, a flag in the row before (next.terminated and next.truncated too), a gap in time, time that goes
back, a jump, rows that were rejected."""

RATE_TOLERANCE = 0.1
"""Largest relative difference between fps and the rate measured from the times."""
_ENOUGH = 20
"""Steps of a file of which its rate can be told."""

Cut = tuple[dict[str, Array], dict[str, Scalar]]
Table = dict[str, Array]
"""Rows: columns by name and, by words without a dot, what decides where they are cut."""


class Cutter:
    """Cuts consecutive blocks into episodes.

    Attributes:
        tally: of the rows so far.
    """

    def __init__(self, mapping: ImportMapping, *, skip_bad: bool = False) -> None:
        """Cut by `mapping`; `skip_bad` leaves out whole episodes with a value that is not finite."""
        self.tally = Tally()
        self._mapping, self._skips = mapping, skip_bad and mapping.not_finite == "refuse"
        self._converter = Converter(mapping)
        self._clock = Clock(mapping.time or "", mapping.fps)
        self._tables: list[Table] = []
        self._rows = self._carried = 0
        self._parts: list[Block] = []
        self._spent: list[NDArray[np.float64]] = []
        self._file = 0
        self._was_torn = self._ended = False

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of the episodes; known after the first block."""
        return self._converter.columns

    def feed(self, block: Block, row: int, *, is_apart: bool) -> Iterator[Cut]:
        """Add `block`; yield the columns and the metadata of episodes that ended.

        Args:
            block: at least one row.
            row: number of its first row in its file.
            is_apart: whether it begins a new file instead of continuing the block before.

        Raises:
            BadInputError: values do not fit their columns, or change in size; lists every fault.
        """
        columns, bad = self._converter.convert(block)
        n, split = len(block), self._mapping.split
        rejected = np.logical_or.reduce([np.zeros(n, bool), *bad.values()])
        self.tally.count(block, row, bad, rejected, self._mapping.all_fields)
        if is_apart or not self._parts or self._parts[-1].origin != block.origin:
            self._parts.append(replace(block, values={}, places={}, known=()))
            self._spent.append(np.zeros(3))
        self._file += is_apart
        fields = {name: np.asarray(values).reshape(n, -1) for name, values in block.values.items()}
        first = np.arange(n) == 0
        table = columns | {
            "finite": ~rejected,
            "row": row + np.arange(n),
            "part": np.full(n, len(self._parts) - 1),
            "in file": np.full(n, self._file),
            "file": first & is_apart,
            "source": first & block.starts & (not block.is_back),
            "back": first & block.is_back,
            "torn": first & self._was_torn,
        }
        table |= {f"ends {name}": fields[name] for name in split.ends}
        table |= {f"ends {name}": columns[name] for name in (TERMINATED, TRUNCATED) if name in columns}
        if split.field:
            table["field"] = fields[split.field]
        if self._mapping.time:
            table["time"] = fields[self._mapping.time][:, 0].astype(np.float64) * self._mapping.time_scale
        for key, values in self._tables[-1].items() if self._tables else ():
            if values.shape[1:] != table[key].shape[1:]:
                sizes = f"{table[key].shape[1]} values, before there were {values.shape[1]}"
                raise BadInputError(f"{block.origin}: split.{key} has {sizes}")
        self._was_torn = block.torn > 0 and self._mapping.not_finite != "drop"
        self._tables.append(table)
        self._rows += n
        if self._rows >= max(BLOCK_ROWS, 2 * self._carried):
            yield from self._cut(is_last=False)

    def finish(self) -> Iterator[Cut]:
        """Yield the episodes that are left."""
        yield from self._cut(is_last=True)

    def abandon(self) -> Iterator[Cut]:
        """Yield the episodes that have ended, and leave out the one that the last file was in."""
        yield from self._cut(is_last=False)
        self._tables = [
            {key: values[table["in file"] != self._file] for key, values in table.items()}
            for table in self._tables
        ]
        self._rows = self._carried = sum(len(table["row"]) for table in self._tables)

    def _cut(self, *, is_last: bool) -> Iterator[Cut]:
        """Yield the episodes in the rows that are held; hold on to the last one unless it `is_last`."""
        if not self._rows:
            return
        table = {key: np.concatenate([each[key] for each in self._tables]) for key in self._tables[0]}
        self._tables = [table]
        [kept] = np.nonzero(table["finite"])
        counts, steps_s = self._reasons(table)
        changed = np.diff(counts[:, kept], axis=1, prepend=counts[:, kept[:1]]) > 0
        reasons = np.insert(changed, REASONS.index("jump"), self._jumped(table, kept), axis=0)
        [begins] = np.nonzero(reasons.any(axis=0))
        # Each rejected row belongs to an episode that no reason but rejected rows keeps it apart from.
        own = counts[:-1].sum(axis=0)
        before = np.maximum.accumulate(np.where(table["finite"], np.arange(len(own)), -1))
        follows = (before >= 0) & (own[before] == own)
        starts: list[int] = [0, *(_first_row(int(kept[at]), before, own) for at in begins), len(own)]
        self._keep_ends(table, before, follows)
        ends = len(starts) - 1 if is_last else max(len(starts) - 2, 0)
        until = len(own) if is_last else starts[ends]
        self._count(table, steps_s, until, is_last=is_last)
        for reason in np.argmax(reasons[:, begins], axis=0):
            name = REASONS[reason]
            self.tally.split_points[name] = self.tally.split_points.get(name, 0) + 1
        is_new = [False, *map(bool, np.atleast_1d(reasons[: REASONS.index("end"), begins].any(axis=0)))]
        columns = {column.name: table[column.name] for column in self.columns if column.name in table}
        for number in range(ends):
            self._ended &= not is_new[number]
            rows = np.arange(starts[number], starts[number + 1])
            finite = table["finite"][rows]
            if finite.any() and not (self._skips and self._has_bad(table, rows[~finite])):
                rows = rows[finite]
                part, row = self._parts[table["part"][rows[0]]], int(table["row"][rows[0]])
                episode = {name: values[rows] for name, values in columns.items()}
                yield from self._episode(episode, {"source": part.origin, "source_row": row})
        if not is_last:
            self._ended &= not is_new[ends]
        self._tables = [{key: values[until:].copy() for key, values in table.items()}]
        self._rows = self._carried = len(own) - until

    def _reasons(self, table: Table) -> tuple[NDArray[np.int64], Array]:
        """Return how often each reason, except jumps, has applied up to each row, (reasons, n).

        And the steps in time to each row from the one before, (n, 3): as recorded, held over rows without a
        time, and held over rows that are dropped, too; NaN where a file or an episode of the format begins.
        """
        n, split, drops = len(table["row"]), self._mapping.split, self._mapping.not_finite == "drop"
        masks: dict[str, Array] = {reason: np.zeros(n, bool) for reason in REASONS if reason != "jump"}
        apart = table["file"] | table["source"] | table["back"]
        for key, values in table.items():
            if key.startswith("ends "):
                masks["end"][1:] |= (np.nan_to_num(as_rows(values)[:-1]) != 0).any(axis=1)
        if split.field:
            earlier, later = table["field"][:-1], table["field"][1:]
            # What is missing (NaN) is the same value again, as empty cells of CSV are.
            are_missing = (earlier != earlier) & (later != later)
            masks["field"][1:] = ((earlier != later) & ~are_missing).any(axis=1)
        steps_s = np.full((n, 3), np.nan)
        if "time" in table:
            times = np.repeat(table["time"][:, None], 3, axis=1)
            times[~table["finite"] & drops, 2] = np.nan
            times[:, 1:] = _held(times[:, 1:], apart)
            steps_s[1:] = np.diff(times, axis=0)
            steps_s[apart] = np.nan
            masks["back"] = steps_s[:, 1] < 0
            if split.gap_s is not None:
                masks["gap"] = np.asarray((steps_s[:, 1:] > split.gap_s).any(axis=1))
        for reason in ("end", "field"):
            masks[reason] &= ~apart
        masks["file"], masks["source"] = table["file"], table["source"]
        masks["back"] |= table["back"]
        masks["rejected"] = table["torn"] | (~table["finite"] & (self._mapping.not_finite == "split"))
        counts: NDArray[np.int64] = np.cumsum(list(masks.values()), axis=1)
        return counts, steps_s

    def _jumped(self, table: Table, kept: NDArray[np.int64]) -> Mask:
        """Return which of the rows that are kept are a jump away from the one before."""
        jump = self._mapping.split.jump
        if not jump:
            return np.zeros(len(kept), bool)
        [column] = (column for column in self.columns if column.name == jump.column)
        where = as_rows(table[jump.column])[np.ix_(kept, np.array(jump.values))].astype(np.float64)
        steps = shortest(np.diff(where, axis=0, prepend=where[:1]), full_turns(column)[list(jump.values)])
        return np.asarray(np.linalg.norm(steps, axis=1) > jump.above)

    def _keep_ends(self, table: Table, before: NDArray[np.int64], follows: Mask) -> None:
        """Where a rejected row ends an episode or succeeds, let the last row that is kept of it do so."""
        flags = [name for name in (TERMINATED, SUCCESS) if name in table]
        rows = np.flatnonzero(~table["finite"] & follows)
        for name in flags:
            np.logical_or.at(table[name], before[rows], table[name][rows])

    def _has_bad(self, table: Table, rejected: NDArray[np.int64]) -> bool:
        """Note an episode that is left out for its `rejected` rows, if there are any."""
        if not len(rejected):
            return False
        where = self._place(table, int(rejected[0]))
        self.tally.bad_episodes.append(f"{where}: a value is not finite: its episode is left out")
        return True

    def _place(self, table: Table, at: int) -> str:
        """Name the row `at` of the table."""
        named: str = self._parts[table["part"][at]].row_name(int(table["row"][at]))
        return named

    def _count(self, table: Table, steps_s: Array, until: int, *, is_last: bool) -> None:
        """Tally what the clock does up to the row `until`, and in the step to it."""
        rows = slice(1, until + (not is_last))
        recorded, held, kept = steps_s[rows].T
        stands = (held == 0) & np.isfinite(recorded)
        for name, mask in (("back", held < 0), ("still", stands)):
            setattr(self.tally, f"{name}_rows", getattr(self.tally, f"{name}_rows") + int(mask.sum()))
            if mask.any() and not getattr(self.tally, f"{name}_first"):
                setattr(self.tally, f"{name}_first", self._place(table, 1 + int(mask.argmax())))
        longest = self._mapping.split.gap_s or np.inf
        regular = (kept > 0) & ~(held > longest) & ~(kept > longest)
        for part in np.unique(table["part"][rows][regular]):
            steps = kept[regular & (table["part"][rows] == part)]
            self._spent[part] += steps.sum(), np.median(steps) * len(steps), len(steps)
            self._clock.count(steps)

    def _episode(self, episode: dict[str, Array], metadata: dict[str, Scalar]) -> Iterator[Cut]:
        """Yield an episode with next states and ends, unless it is too short."""
        ended_before, self._ended = self._ended, is_terminated(episode)
        length = len(next(iter(episode.values())))
        if ended_before and self._ended and length == 1 and NEXT_STATE not in episode:
            self.tally.rows_after_end += 1
            return
        if STATE in episode and NEXT_STATE not in episode:
            episode = self._with_next_states(episode)
            length = len(episode[STATE])
        if length < self._mapping.min_steps:
            self.tally.short_rows += length
            return
        terminated = episode.setdefault(TERMINATED, np.zeros(length, bool))
        truncated = episode.get(TRUNCATED, np.zeros(length, bool)).copy()
        truncated[-1] |= not terminated[-1]
        episode |= {TRUNCATED: truncated, DONE: terminated | truncated}
        self.tally.endings.add(episode)
        if REWARD in episode:
            metadata["return"] = float(episode[REWARD].sum(dtype=np.float64))
        yield episode, metadata

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
        timed = [
            (part.origin, spent) for part, spent in zip(self._parts, self._spent, strict=True) if spent.any()
        ]
        if not timed:
            return
        fps, spent = self._mapping.fps, np.array([spent for _, spent in timed])
        rates = spent[:, 2:] / spent[:, :2]
        off = (np.abs(rates / fps - 1) > RATE_TOLERANCE).all(axis=1) & (spent[:, 2] >= _ENOUGH)
        named = [f"{timed[at][0]}: {rates[at, 1]:.4g} Hz" for at in np.flatnonzero(off)]
        seconds, usual_seconds, steps = spent.sum(axis=0)
        pooled = steps / seconds, steps / usual_seconds
        if all(abs(rate / fps - 1) > RATE_TOLERANCE for rate in pooled):
            advice = "correct fps or time_scale, or resample the recording"
            if self.tally.back_rows:
                advice += (
                    f"; time goes back in {self.tally.back_rows} rows, first in {self.tally.back_first}: "
                    "sort them if they belong together"
                )
            if named and len(timed) > 1:
                advice += f"; {first_few(named, 8)}"
            raise BadInputError(
                f"'{self._mapping.time}' gives {pooled[0]:.4g} rows per second, but fps is {fps}: {advice}"
            )
        self.tally.notes += [f"{name}, {fps} Hz declared" for name in named]
        self.tally.clock = str(self._clock)


def _held(times: Array, apart: Mask) -> Array:
    """Replace what is not finite in `times` (n, k) by the last finite one, none from before rows `apart`."""
    rows = np.arange(len(times))[:, None]
    known = np.where(np.isfinite(times) | apart[:, None], rows, 0)
    held: Array = np.take_along_axis(times, np.maximum.accumulate(known, axis=0), axis=0)
    return held


def _first_row(row: int, before: NDArray[np.int64], own: NDArray[np.int64]) -> int:
    """Return the first of the rejected rows right before the kept `row` that belong to its episode."""
    earlier = int(before[row - 1]) + 1 if row else 0
    return row - int((own[earlier:row] == own[row]).sum())
