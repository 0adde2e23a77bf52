"""Turn the rows of recordings into columns, and cut them into episodes.

Rows are cut once a file has ended, a recording whose files continue one another, or an episode of a format that has its
own.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from astra_data.core.arrays import Bools, Floats, as_column, as_rows
from astra_data.core.errors import BadInputError
from astra_data.core.naming import first_few
from astra_data.dataset import columns as keys
from astra_data.dataset.checkup import Clock, full_turns, shortest
from astra_data.dataset.columns import Array, Column, Scalar
from astra_data.dataset.inspection import Endings, is_terminated
from astra_data.dataset.lerobot_recording import DERIVED_FLAGS, next_state_of
from astra_data.io.mapping import MAPPED_FLAGS, ColumnMapping, ImportMapping
from astra_data.io.recording import Block

REASONS = ("file", "source", "field", "end", "gap", "back", "jump", "rejected")
"""Why a new episode begins, the first that applies: a new file, the format's own episodes, a field that
changes, a flag in the row before (next.terminated and next.truncated too), a gap in time, time that goes
back, a jump, rows that were rejected."""
RATE_TOLERANCE = 0.1  # largest relative difference between fps and the rate measured from the times
_TIMED = 20  # steps of a file of which its rate can be told
EXACT = 2**53  # floats represent whole numbers below this exactly
_SHOWN = 8  # fields and files that are listed
_KINDS = {"U": "text", "S": "text", "O": "values that are not numbers, such as missing ones"}

Cut = tuple[dict[str, Array], dict[str, Scalar]]  # the columns and the metadata of an episode
Table = dict[str, Array]  # columns by name, and what decides cuts, by words that begin with "/" as no column does


@dataclass
class Tally:
    """How many rows were read and dropped, and why."""

    rows: int = 0
    rejected_rows: int = 0  # those with a value that is not finite, and torn ones
    not_finite: dict[str, tuple[int, str]] = field(default_factory=dict)  # field: count of rows, where the first is
    bad_episodes: list[str] = field(default_factory=list)  # those that are left out for such a row, in a line each
    torn_rows: int = 0  # those that are cut off at the end of their files
    torn_first: str = ""
    split_points: dict[str, int] = field(default_factory=dict)  # number of boundaries between episodes, by reason
    last_rows: int = 0  # last rows of episodes, dropped because their next state was not recorded ...
    last_terminated: int = 0  # ... those of them that were terminated, and the sum of the rewards of the others
    last_reward: float = 0.0
    back_rows: int = 0  # those at which time goes back, within a file
    back_first: str = ""
    still_rows: int = 0  # those with the time of the row before
    still_first: str = ""
    short_rows: int = 0  # rows of episodes that were too short
    rows_after_end: int = 0  # terminated rows right after a terminated one: the log went on, the episode did not
    endings: Endings = field(default_factory=Endings)
    clock: str = ""  # the recorded rate, gaps and jitter, where the mapping names the times
    unused_fields: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # what is strange about the rates of files, in a line each
    topics: dict[str, list[str]] = field(default_factory=dict)  # strange about topics, a line each: its files

    @property
    def faults(self) -> str:
        """Which fields are not finite, and where."""
        rows = self.rows - self.torn_rows
        empty = [name for name, (count, _) in self.not_finite.items() if count == rows]
        parts = [f"{first_few(empty, _SHOWN)} is empty in all {rows} rows: leave it out"] if empty else []
        for name, (count, place) in self.not_finite.items():
            where = f"1 row, {place}" if count == 1 else f"{count} rows, first {place}"
            parts += [f"{name} in {where}"] if count < rows else []
        return "; ".join(parts[:_SHOWN]) + (f" and {len(parts) - _SHOWN} more" if len(parts) > _SHOWN else "")


_LARGE = 2**16  # numbers beyond it that float32 cannot hold are refused: times, and positions far from their origin
_ROUNDED = 0.05  # mean error of a step, as a share of a typical step, from which on rounding is warned of ...
_LOST = 0.5  # ... and from which on large numbers are refused
_TYPICAL = 0.9  # quantile of the steps that is typical: robots often stand still, and their sensors do not
_ENOUGH = 10  # fewer steps tell nothing of rounding
_SAMPLES, _MOST_SAMPLES = 2**9, 2**15  # steps that are looked at in a block, and in all


class Rounding:
    """Compares the steps of a column's values (n, size) with those that float32 holds."""

    def __init__(self, column: Column, offset: Sequence[float] = ()) -> None:
        self._column, self._offset = column, offset
        self._low, self._high = np.full(column.size, np.inf), np.full(column.size, -np.inf)
        self._samples: list[Array] = []

    def add(self, values: Array, held: Array) -> None:
        """Look at consecutive rows, all finite."""
        exact = values.astype(np.float64)
        self._low = np.minimum(self._low, exact.min(axis=0, initial=np.inf))
        self._high = np.maximum(self._high, exact.max(axis=0, initial=-np.inf))
        rows = np.arange(0, len(exact) - 1, max(1, len(exact) // _SAMPLES))
        whole = values.astype(np.int64) if values.dtype.kind in "iu" else exact  # larger integers are no float64
        steps = np.asarray(whole[rows + 1] - whole[rows], np.float64)
        errors = held[rows + 1].astype(np.float64) - held[rows] - steps
        # Less is the noise of a computation with float64, if it is no count.
        steps[(np.abs(steps) < 64 * np.spacing(np.abs(exact[rows]))) & (steps % 1 != 0)] = 0.0
        self._samples.append(np.abs([steps, errors]))
        if sum(part.shape[1] for part in self._samples) > _MOST_SAMPLES:
            self._samples = [np.concatenate(self._samples, axis=1)[:, ::2]]

    def found(self) -> tuple[str, bool] | None:
        """Return a warning, and whether most steps are lost; None where all are held well enough."""
        if not self._samples:
            return None
        steps, errors = np.concatenate(self._samples, axis=1)
        lost, helps, coarse = False, True, []
        offset = np.broadcast_to(self._offset or 0.0, self._column.size).tolist()
        for entry, (low, high) in enumerate(zip(self._low.tolist(), self._high.tolist(), strict=True)):
            moved = steps[:, entry] > 0
            if moved.sum() < _ENOUGH:
                continue
            step = float(np.quantile(steps[moved, entry], _TYPICAL))
            share = float(errors[moved, entry].mean()) / step
            if share < _ROUNDED:
                continue
            largest = max(-low, high)
            spacing = float(np.spacing(np.float32(largest)))
            is_count = spacing <= 2 and step == round(step)
            lost |= share >= _LOST and largest > _LARGE and not is_count
            digit = 10.0 ** np.floor(np.log10(max(high - low, step)))
            offset[entry] = round(offset[entry] - digit * round((low + high) / 2 / digit), 12)
            helps &= float(np.spacing(np.float32(high - low))) / 3 < _ROUNDED * step
            name = self._column.names[entry] if self._column.names else f"entry {entry}"
            coarse.append(f"{name} (up to {largest:.6g}) in steps of {spacing:.2g}, but it moves by {step:.2g}")
        if not coarse:
            return None
        listed = ", ".join(f"{one:.1f}" if one == round(one) else f"{one:.15g}" for one in offset)
        advice = f"set offset = [{listed}]" if helps else "leave out what is a time"
        if lost and helps:
            advice += ', leave out what is a time, or store counts with dtype = "int64"'
        return f"columns.{self._column.name}: float32 holds {'; '.join(coarse)}: {advice}", lost


class Cutter:
    """Cuts consecutive blocks into episodes; `skip_bad` leaves out those with a value that is not finite."""

    def __init__(self, mapping: ImportMapping, *, skip_bad: bool = False) -> None:
        self.tally = Tally()
        self.columns: tuple[Column, ...] = ()  # of the dataset, including derived ones; known after the first block
        self.mapping, self._skips = mapping, skip_bad and mapping.not_finite == "refuse"
        self._converted: dict[str, Column] = {}
        self._rounding: dict[str, Rounding] = {}
        self._clock = Clock(mapping.time or "", mapping.fps)
        self._tables: list[Table] = []
        self._parts: list[Block] = []
        self._spent: list[Floats] = []
        self._begins = "file"
        self._has_rows = self._was_torn = self._ended = False

    def feed(self, block: Block, *, is_apart: bool) -> Iterator[Cut]:
        """Add `block`, which begins a new file if it `is_apart`; yield the columns and metadata of ended episodes."""
        if is_apart or block.starts:
            yield from self.cut()
            self._begins = "file" if is_apart else "source"
        columns, bad = self.convert(block)
        n, mapping = len(block), self.mapping
        rejected = np.logical_or.reduce([np.zeros(n, bool), *bad.values()])
        self._count(block, bad, rejected)
        if is_apart or not self._parts or self._parts[-1].origin != block.origin:
            self._parts.append(replace(block, values={}, places={}, known=()))
            self._spent.append(np.zeros(3))
        fields = {name: np.asarray(values).reshape(n, -1) for name, values in block.values.items()}
        ends = [fields[name] for name in mapping.split.ends]
        ends += [columns[name].reshape(n, -1) for name in (keys.TERMINATED, keys.TRUNCATED) if name in columns]
        times = fields[mapping.time][:, 0] if mapping.time else np.full(n, np.nan)
        table = columns | {
            "/finite": ~rejected,
            "/row": block.row + np.arange(n),
            "/part": np.full(n, len(self._parts) - 1),
            "/torn": (np.arange(n) == 0) & self._was_torn,
            "/end": np.logical_or.reduce([np.zeros(n, bool), *((np.nan_to_num(v) != 0).any(axis=1) for v in ends)]),
            "/time": times.astype(np.float64) * mapping.time_scale,
            "/field": fields[mapping.split.field] if mapping.split.field else np.zeros((n, 1)),
        }
        if self._tables and (before := self._tables[-1]["/field"].shape[1]) != (size := table["/field"].shape[1]):
            raise BadInputError(f"{block.origin}: split.field has {size} values, before there were {before}")
        self._was_torn = block.torn > 0 and mapping.not_finite != "drop"
        self._tables.append(table)

    def cut(self) -> Iterator[Cut]:
        """Yield the episodes in the rows that are held, and hold none."""
        if not self._tables:
            return
        table = {key: np.concatenate([each[key] for each in self._tables]) for key in self._tables[0]}
        self._tables = []
        [kept] = np.nonzero(table["/finite"])
        n = len(table["/row"])
        masks: dict[str, Array] = {reason: np.zeros(n, bool) for reason in REASONS}
        masks["end"][1:] = table["/end"][:-1]
        earlier, later = table["/field"][:-1], table["/field"][1:]
        # What is missing (NaN) is the same value again, as empty cells of CSV are.
        masks["field"][1:] = ((earlier != later) & ~((earlier != earlier) & (later != later))).any(axis=1)
        times = np.repeat(table["/time"][:, None], 3, axis=1)
        times[~table["/finite"] & (self.mapping.not_finite == "drop"), 2] = np.nan
        known = np.where(np.isfinite(times[:, 1:]), np.arange(n)[:, None], 0)
        times[:, 1:] = np.take_along_axis(times[:, 1:], np.maximum.accumulate(known), axis=0)
        # As recorded, held over rows without a time, and held over rows that are dropped, too.
        steps_s = np.diff(times, axis=0, prepend=np.full((1, 3), np.nan))
        masks["back"] = steps_s[:, 1] < 0
        masks["gap"] = np.asarray((steps_s[:, 1:] > (self.mapping.split.gap_s or np.inf)).any(axis=1))
        masks["rejected"] = table["/torn"] | (~table["/finite"] & (self.mapping.not_finite == "split"))
        jumps = np.zeros(n, bool)
        if jump := self.mapping.split.jump:
            [column] = (column for column in self.columns if column.name == jump.column)
            where = as_rows(table[jump.column])[np.ix_(kept, np.array(jump.values))].astype(np.float64)
            moved = shortest(np.diff(where, axis=0, prepend=where[:1]), full_turns(column)[list(jump.values)])
            jumps[kept] = np.linalg.norm(moved, axis=1) > jump.above
        self._count_time(table, steps_s, masks["field"] | masks["end"] | masks["gap"] | jumps)
        if not len(kept):
            return
        # How often each reason has applied up to each row, but for jumps and what begins the first.
        counts = np.cumsum([masks[reason] for reason in REASONS], axis=1)
        reasons = np.diff(counts[:, kept], axis=1, prepend=counts[:, kept[:1]]) > 0
        reasons[REASONS.index("jump")] = jumps[kept]
        reasons[REASONS.index(self._begins), 0] = self._has_rows
        self._has_rows = True
        [begins] = np.nonzero(reasons.any(axis=0))
        for reason in np.argmax(reasons[:, begins], axis=0):
            name = REASONS[reason]
            self.tally.split_points[name] = self.tally.split_points.get(name, 0) + 1
        starts = [0, *begins[begins > 0].tolist()]
        # A rejected row is of the episode after it or else before it, by all reasons but rejected rows.
        rows, apart = np.arange(n), counts[:-1].sum(axis=0)
        before = np.searchsorted(kept, rows, side="right") - 1
        after = np.minimum(np.searchsorted(kept, rows), len(kept) - 1)
        is_of_next = (before < 0) | (apart[kept[after]] == apart)
        episode = np.searchsorted(starts, np.where(is_of_next, after, before), side="right") - 1
        [rejected] = np.nonzero(~table["/finite"])
        ends = rejected[(before[rejected] >= 0) & (apart[kept[before[rejected]]] == apart[rejected])]
        for name in (keys.TERMINATED, keys.SUCCESS):
            if name in table:  # if a rejected row ends its episode, the last row of it that is kept does so
                np.logical_or.at(table[name], kept[before[ends]], table[name][ends])
        bad = {int(episode[at]): at for at in rejected[::-1].tolist()} if self._skips else {}
        is_new = np.asarray(reasons[: REASONS.index("end")].any(axis=0))
        for number, part in enumerate(np.split(kept, starts[1:])):
            self._ended &= not is_new[starts[number]]
            if number in bad:
                where = self._place(table, bad[number])
                self.tally.bad_episodes.append(f"{where}: a value is not finite: its episode is left out")
                continue
            values = {column.name: table[column.name][part] for column in self.columns if column.name in table}
            source = {"source": self._parts[table["/part"][part[0]]].origin}
            yield from self._episode(values, source | {"source_row": int(table["/row"][part[0]])})

    def _place(self, table: Table, at: int) -> str:
        return str(self._parts[table["/part"][at]].row_name(int(table["/row"][at])))

    def _count(self, block: Block, bad: dict[str, Bools], rejected: Bools) -> None:
        tally = self.tally
        tally.rows += len(block) + block.torn
        tally.rejected_rows += int(rejected.sum()) + block.torn
        for name, mask in bad.items():
            before, place = tally.not_finite.get(name) or (0, block.place(int(mask.argmax())))
            tally.not_finite[name] = before + int(mask.sum()), place
        if block.torn:
            tally.torn_rows += block.torn
            tally.torn_first = tally.torn_first or block.row_name(block.row + len(block))
        known = {*self.mapping.all_fields, *tally.unused_fields}
        tally.unused_fields += [name for name in block.known if name not in known]
        for note in block.notes:
            tally.topics.setdefault(note.removeprefix(f"{block.origin}: "), []).append(block.origin)

    def _count_time(self, table: Table, steps_s: Array, begins: Bools) -> None:
        """Count what is wrong with times, and how much passes in steps that begin no episode, as `begins` says."""
        recorded, held, kept = steps_s.T
        stands = (held == 0) & np.isfinite(recorded)
        for name, mask in (("back", held < 0), ("still", stands)):
            setattr(self.tally, f"{name}_rows", getattr(self.tally, f"{name}_rows") + int(mask.sum()))
            if mask.any() and not getattr(self.tally, f"{name}_first"):
                setattr(self.tally, f"{name}_first", self._place(table, int(mask.argmax())))
        regular = (kept > 0) & ~begins
        for part in np.unique(table["/part"][regular]):
            steps = kept[regular & (table["/part"] == part)]
            self._spent[part] += steps.sum(), np.median(steps) * len(steps), len(steps)
            self._clock.count(steps)

    def _episode(self, episode: dict[str, Array], metadata: dict[str, Scalar]) -> Iterator[Cut]:
        """Yield an episode with next states and ends, unless it is too short."""
        ended_before, self._ended = self._ended, is_terminated(episode)
        length = len(next(iter(episode.values())))
        if ended_before and self._ended and length == 1 and keys.NEXT_STATE not in episode:
            self.tally.rows_after_end += 1
            return
        if keys.STATE in episode and keys.NEXT_STATE not in episode:
            episode = self._with_next_states(episode)
            length = len(episode[keys.STATE])
        if length < self.mapping.min_steps:
            self.tally.short_rows += length
            return
        terminated = episode.setdefault(keys.TERMINATED, np.zeros(length, bool))
        truncated = episode.get(keys.TRUNCATED, np.zeros(length, bool)).copy()
        truncated[-1] |= not terminated[-1]
        episode |= {keys.TRUNCATED: truncated, keys.DONE: terminated | truncated}
        self.tally.endings.add(episode)
        if keys.REWARD in episode:
            metadata["return"] = float(episode[keys.REWARD].sum(dtype=np.float64))
        yield episode, metadata

    def _with_next_states(self, episode: dict[str, Array]) -> dict[str, Array]:
        """Add the state of the next row to each row, and drop the last or let it stand still."""
        state, terminated, tally = episode[keys.STATE], is_terminated(episode), self.tally
        if terminated and self.mapping.terminal == "stand_still":
            return episode | {keys.NEXT_STATE: np.concatenate([state[1:], state[-1:]])}
        tally.last_rows += 1
        tally.last_terminated += terminated
        kept = {name: values[:-1].copy() for name, values in episode.items()}
        is_handed = len(state) > 1 and terminated
        if len(state) > 1 and keys.SUCCESS in kept:
            # The row's state is the one that the step before leads to.
            kept[keys.SUCCESS][-1] = episode[keys.SUCCESS][-1] or (kept[keys.SUCCESS][-1] and not terminated)
        if is_handed:
            kept[keys.TERMINATED][-1] = True
        if keys.REWARD in kept and is_handed:
            kept[keys.REWARD][-1] += episode[keys.REWARD][-1]
        elif keys.REWARD in kept:
            tally.last_reward += float(episode[keys.REWARD][-1])
        return kept | {keys.NEXT_STATE: state[1:]}

    def check(self) -> None:
        """Compare fps to the rates of files, on average and without pauses; tally these, and what float32 rounds."""
        tally, fps, time = self.tally, self.mapping.fps, self.mapping.time
        found = [each for rounding in self._rounding.values() if (each := rounding.found())]
        if lost := [warning for warning, is_lost in found if is_lost]:
            raise BadInputError("; ".join(lost))
        tally.notes += [warning for warning, _ in found]
        timed = [(part.origin, spent) for part, spent in zip(self._parts, self._spent, strict=True) if spent.any()]
        if not timed and not tally.still_rows:
            return
        spent = np.array([spent for _, spent in timed]).reshape(-1, 3)
        rates = spent[:, 2:] / spent[:, :2]
        off = (np.abs(rates / fps - 1) > RATE_TOLERANCE).all(axis=1) & (spent[:, 2] >= _TIMED)
        named = [f"{timed[at][0]}: {rates[at, 1]:.4g} Hz" for at in np.flatnonzero(off)]
        seconds, usual_seconds, steps = spent.sum(axis=0)
        if timed and all(abs(steps / each / fps - 1) > RATE_TOLERANCE for each in (seconds, usual_seconds)):
            advice = ["correct fps or time_scale, or resample the recording"]
            if tally.back_rows:
                back = f"time goes back in {tally.back_rows} rows, first in {tally.back_first}"
                advice.append(f"{back}: sort them if they belong together")
            if named and len(timed) > 1:
                advice.append(first_few(named, _SHOWN))
            given = f"'{time}' gives {steps / seconds:.4g} rows per second, but fps is {fps}"
            raise BadInputError(f"{given}: {'; '.join(advice)}")
        if 2 * tally.still_rows > steps:
            why = f"'{time}' stands still in {tally.still_rows} of {tally.rows} rows, first in {tally.still_first}"
            raise BadInputError(f"{why}: expected one row at a time: remove copies or split where another robot begins")
        tally.notes += [f"{name}, {fps} Hz declared" for name in named]
        tally.clock = str(self._clock)

    def convert(self, block: Block) -> tuple[dict[str, Array], dict[str, Bools]]:
        """Return the columns of `block`, (n,) or (n, size), and the rows where fields are not finite."""
        faults: list[str] = []
        fields = {name: _as_rows(name, block.values[name], faults) for name in self.mapping.fields}
        if faults:
            raise BadInputError(f"{block.origin}: {'; '.join(faults)}")
        columns, bad = {}, dict[str, Bools]()
        for name in (*self.mapping.split.ends, *([self.mapping.time] if self.mapping.time else [])):
            bad[name] = np.asarray(~np.isfinite(fields[name]).all(axis=1))
        for name, spec in self.mapping.columns.items():
            try:
                values = _transformed(np.concatenate([fields[f] for f in spec.fields], axis=1), spec)
                column = self._converted.get(name) or column_of(name, spec, values.shape[1])
                if values.shape[1] != column.size:
                    raise BadInputError(f"{values.shape[1]} values, before there were {column.size}")
                cast, finite = _cast(values, column)
                ok = finite.all(axis=1)
                if column.dtype == "float32" and not np.can_cast(values.dtype, np.float32):
                    self._rounding.setdefault(name, Rounding(column, spec.offset)).add(values[ok], cast[ok])
            except BadInputError as error:
                faults.append(f"columns.{name}: {error}")
                continue
            self._converted[name] = column
            columns[name] = as_column(cast)
            widths = [(field, fields[field].shape[1]) for field in spec.fields]
            sources = [f"{field}[{at}]" if n > 1 else field for field, n in widths for at in range(n)]
            for entry in np.flatnonzero(~finite.all(axis=0)).tolist():
                source = sources[spec.take[entry] if spec.take else entry]
                bad[source] = bad.get(source, False) | ~finite[:, entry]
        sizes = {name: column.size for name, column in self._converted.items()} if not faults else {}
        of_state, of_next = sizes.get(keys.STATE, 0), sizes.get(keys.NEXT_STATE)
        if of_next not in (None, of_state):
            faults.append(f"{keys.NEXT_STATE} has {of_next} values, {keys.STATE} {of_state}")
        flags = [name for name in (keys.REWARD, *MAPPED_FLAGS) if sizes.get(name, 1) > 1]
        faults += [f"{name}: {sizes[name]} values, expected 1" for name in flags]
        if sizes and (jump := self.mapping.split.jump) and max(jump.values) >= (size := sizes[jump.column]):
            where = f"{jump.column} has {size} values, counted from 0"
            faults.append(f"split.jump.values {list(jump.values)}: {where}")
        if faults:
            raise BadInputError(f"{block.origin}: {'; '.join(faults)}")
        self.columns = self.columns or _complete(self._converted, self.mapping.terminal)
        return columns, {name: mask for name, mask in bad.items() if mask.any()}


def column_of(name: str, spec: ColumnMapping, size: int) -> Column:
    """Return the column `name` with `size` values, or raise BadInputError."""
    lists: dict[str, Sequence[str]] = {"unit": spec.unit, "frame": spec.frame, "role": spec.role}
    for key, words in lists.items():
        if len(words) not in (0, 1, size):
            raise BadInputError(f"{key} has {len(words)} words for {size} values")
    astra = {key: list(words) * (size if len(words) == 1 else 1) for key, words in lists.items() if words}
    dtype = spec.dtype or ("bool" if name in MAPPED_FLAGS else "float32")
    # Fields of one value each name what they hold; `size` tells that none holds more.
    names = spec.names or (spec.fields if len(spec.fields) == size > 1 and not spec.take else None)
    return Column(name, dtype, size, names, spec.meaning, astra or None)


def _complete(converted: dict[str, Column], terminal: str) -> tuple[Column, ...]:
    columns = dict(converted)
    if keys.STATE in columns:
        following = next_state_of(columns[keys.STATE])
        if recorded := columns.get(keys.NEXT_STATE):
            names, meaning = recorded.names or following.names, recorded.meaning or following.meaning
            astra = {**(following.astra or {}), **(recorded.astra or {})} or None
            following = replace(following, names=names, meaning=meaning, astra=astra)
        elif keys.TERMINATED in columns and terminal == "stand_still":
            made_up = "; where an episode terminates, not recorded: the state itself"
            following = replace(following, meaning=f"{following.meaning}{made_up}")
        columns[keys.NEXT_STATE] = following
    return (*columns.values(), *(column for column in DERIVED_FLAGS if column.name not in columns))


def _as_rows(name: str, values: Array, faults: list[str]) -> Array:
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        faults.append(f"field '{name}': expected numbers, got {_KINDS.get(array.dtype.kind, array.dtype)}")
    elif 0 in array.shape:
        faults.append(f"field '{name}' has no values, its shape is {array.shape}")
    return array.reshape(len(array), -1)


def _transformed(values: Array, spec: ColumnMapping) -> Array:
    if spec.take:
        if max(spec.take) >= values.shape[1]:
            size = f"{', '.join(spec.fields)} hold {values.shape[1]} values, counted from 0"
            raise BadInputError(f"take {list(spec.take)}: {size}")
        values = values[:, list(spec.take)]
    for key, numbers in (("scale", spec.scale), ("offset", spec.offset)):
        if len(numbers) not in (0, 1, values.shape[1]):
            raise BadInputError(f"{key} has {len(numbers)} numbers for {values.shape[1]} values")
    with np.errstate(over="ignore", invalid="ignore"):
        values = values * np.array(spec.scale) if spec.scale else values
        values = values + np.array(spec.offset) if spec.offset else values
    return values if spec.clip is None else np.where(np.isfinite(values), np.clip(values, *spec.clip), values)


def _cast(values: Array, column: Column) -> tuple[Array, Bools]:
    """Return `values` (n, size) in the column's dtype, and which of them are finite."""
    finite: Bools = np.asarray(np.isfinite(values))
    sound = values[finite.all(axis=1)]
    if column.dtype == "float32":
        if sound.dtype.kind in "iu" and ((sound > EXACT) | (sound < -EXACT)).any():
            advice = 'set dtype = "int64", or a scale or an offset that makes them small'
            raise BadInputError(f"integers beyond 2^53 do not fit float32; {advice}")
        with np.errstate(over="ignore"):
            cast = np.ascontiguousarray(values, np.float32)
        return cast, finite & np.isfinite(cast)
    if column.dtype == "bool" and not np.isin(sound, (0, 1)).all():
        raise BadInputError("expected true and false, or 1 and 0")
    if column.dtype == "int64" and sound.dtype.kind == "f":
        if not (sound == np.floor(sound)).all():
            raise BadInputError("expected whole numbers")
        if (abs(sound.astype(float)) >= EXACT).any():
            raise BadInputError(
                "numbers of 2^53 or more came as floats, which cannot represent them; expected integers: no fractions "
                "or empty cells among them, no float fields in the column, no scale, offset or clip"
            )
    elif column.dtype == "int64" and sound.dtype == np.uint64 and (sound >= 2**63).any():
        raise BadInputError("expected whole numbers below 2^63")
    whole = np.asarray(finite.all(axis=1))
    return np.where(whole[:, None], values, 0).astype(column.dtype), finite
