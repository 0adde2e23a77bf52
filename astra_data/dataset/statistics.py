"""Statistics of columns in float64, with LeRobot's names and shapes."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from astra_data.core.arrays import Floats, as_rows
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.format import EPISODES_PATH, QUANTILES, STATISTICS, STORED_STATISTICS, episodes_schema
from astra_data.dataset.parquet import RotatingWriter, to_arrow
from astra_data.dataset.plain import PlainColumn

ROWS_AT_ONCE = 1000  # rows held in memory before they are written


def episode_statistics(columns: Iterable[Array]) -> Floats:
    """Return `STATISTICS` (9, sum of sizes) of `columns` (T,) or (T, size), side by side."""
    values = [as_rows(column) for column in columns]
    count = len(values[0])
    # One row per index: numpy then sums pairwise, and sorting is fast.
    rows = np.empty((sum(column.shape[1] for column in values), count))
    np.concatenate([column.T for column in values], out=rows)
    mean, std = rows.mean(axis=1), rows.std(axis=1)
    rows.sort(axis=1)
    position = np.array(QUANTILES) * (count - 1)
    below = np.floor(position).astype(np.intp)
    lower, upper = rows[:, below], rows[:, np.ceil(position).astype(np.intp)]
    quantiles = lower + (upper - lower) * (position - below)
    return np.vstack([rows[:, 0], rows[:, -1], mean, std, quantiles.T])


def pooled(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the statistics over several episodes from those of each, as lerobot does; quantiles are estimates."""
    known = [key for key in STORED_STATISTICS if all(part.get(key) is not None for part in parts)]
    if not parts or not {*known} >= {"count", "min", "max", "mean", "std"}:
        return {}
    values = {key: np.array([part[key] for part in parts], float) for key in known}
    count = values["count"].reshape(-1, *([1] * (values["mean"].ndim - 1)))
    found = {key: (value * count).sum(axis=0) / count.sum() for key, value in values.items()}
    spread = values["std"] ** 2 + (values["mean"] - found["mean"]) ** 2
    found |= {"min": values["min"].min(axis=0), "max": values["max"].max(axis=0)}
    found |= {"std": np.sqrt((spread * count).sum(axis=0) / count.sum())}
    counts = {"count": [int(values["count"].sum())]}
    return {key: value.tolist() for key, value in found.items()} | counts


def side_by_side[C: (Column, PlainColumn)](columns: Iterable[C]) -> Iterator[tuple[C, slice]]:
    """Yield each of `columns` with the slice of its values, where those of all stand side by side."""
    first = 0
    for column in columns:
        yield column, slice(first, first + column.size)
        first += column.size


def ranges(blocks: Iterable[Mapping[str, Array]]) -> dict[str, dict[str, Any]]:
    """Return min, max and mean of each index of the columns in `blocks`, each (n,) or (n, size)."""
    found: dict[str, dict[str, Any]] = {}
    totals: dict[str, Floats] = {}
    rows = 0
    for block in blocks:
        for name, values in block.items():
            table = as_rows(values).astype(np.float64)
            low, high, total = table.min(axis=0), table.max(axis=0), table.sum(axis=0)
            before = found.get(name, {"min": low, "max": high})
            found[name] = {"min": np.minimum(before["min"], low), "max": np.maximum(before["max"], high)}
            totals[name] = totals.get(name, np.zeros(len(total))) + total
        rows += len(next(iter(block.values()), ()))
    return {name: extremes | {"mean": totals[name] / rows} for name, extremes in found.items()}


class EpisodeRows:
    """Writes meta/episodes, one row per `append`."""

    def __init__(self, root: Path, columns: list[Column], task: str, cameras: Mapping[str, Mapping[str, Any]]) -> None:
        self._columns, self._task, self._schema = columns, task, episodes_schema(columns, cameras)
        self.pictures: list[Mapping[str, Any]] = []
        kept = [f"stats/{column.name}/{name}.list.element" for column in columns for name in STATISTICS]
        encodings = dict.fromkeys(kept, "BYTE_STREAM_SPLIT")
        self._writer = RotatingWriter(root, EPISODES_PATH, self._schema, encodings, "zstd")
        self._rows: list[tuple[int, int, int]] = []
        self._statistics: list[Floats] = []
        self._total: dict[str, Any] = {}
        self._episodes = self._frames = 0

    def append(self, length: int, chunk: int, file: int, statistics: Floats, pictures: Mapping[str, Any]) -> None:
        """Append an episode of `length` steps in data file `file` of `chunk`; `statistics` (9, sum of sizes).

        `pictures` are the places and statistics of its cameras, by the columns' names.
        """
        self.pictures.append(pictures)
        self._rows.append((length, chunk, file))
        self._statistics.append(statistics)
        if len(self._rows) == ROWS_AT_ONCE:
            self._flush()

    def close(self) -> None:
        """Write the remaining rows and the footer."""
        if self._rows:
            self._flush()
        self._writer.close()

    def statistics(self) -> dict[str, dict[str, list[Any]]]:
        """Return those of all episodes that were written, by column, as in meta/stats.json."""
        return {
            column.name: {key: values if key == "count" else values[part] for key, values in self._total.items()}
            for column, part in side_by_side(self._columns)
        }

    def abandon(self) -> None:
        """Close a file that is not wanted any more."""
        self._writer.abandon()

    def _flush(self) -> None:
        count = len(self._rows)
        chunk, file = self._writer.locate()
        lengths, chunks, files = np.array(self._rows, dtype=np.int64).T
        ends = self._frames + np.cumsum(lengths)
        episodes = np.arange(self._episodes, self._episodes + count)
        rows: list[Array] = [lengths, chunks, files, ends - lengths, ends]
        arrays = [to_arrow(episodes), pa.array([[self._task]] * count), *map(to_arrow, rows)]
        counted = zip(self._statistics, lengths[:, None], strict=True)
        parts = [dict(zip(STATISTICS, one, strict=True)) | {"count": steps} for one, steps in counted]
        self._total = pooled([self._total, *parts] if self._total else parts)
        stacked = np.stack(self._statistics)
        for column, part in side_by_side(self._columns):
            if column.dtype == "float32":  # more digits would take more room than the values of short episodes
                stacked[:, :, part] = stacked[:, :, part].astype(np.float32)
            for name in STORED_STATISTICS:
                values = lengths[:, None] if name == "count" else stacked[:, STATISTICS.index(name), part]
                arrays.append(to_arrow(values))
        for field in self._schema.names[len(arrays) : -2]:
            known = (one.get(field) for one in self.pictures[self._episodes : self._episodes + count])
            arrays.append(pa.array(known, self._schema.field(field).type))
        arrays += [to_arrow(np.full(count, chunk)), to_arrow(np.full(count, file))]
        self._writer.write(pa.Table.from_arrays(arrays, self._schema.names).cast(self._schema))
        self._episodes += count
        self._frames = int(ends[-1])
        self._rows.clear()
        self._statistics.clear()


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
