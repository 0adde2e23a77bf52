"""Statistics of columns in float64, with LeRobot's names and shapes."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from astra_data.core.arrays import Floats, as_rows
from astra_data.dataset import format as layout
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.plain import PlainColumn

ROWS_AT_ONCE = 1000  # rows held in memory before they are written


def episode_statistics(columns: Iterable[Array]) -> Floats:
    """Return `layout.STATISTICS` (9, sum of sizes) of `columns` (T,) or (T, size), side by side."""
    values = [as_rows(column) for column in columns]
    count = len(values[0])
    # One row per index: numpy then sums pairwise, and sorting is fast.
    rows = np.empty((sum(column.shape[1] for column in values), count))
    np.concatenate([column.T for column in values], out=rows)
    mean, std = rows.mean(axis=1), rows.std(axis=1)
    rows.sort(axis=1)
    position = np.array(layout.QUANTILES) * (count - 1)
    below = np.floor(position).astype(np.intp)
    lower, upper = rows[:, below], rows[:, np.ceil(position).astype(np.intp)]
    quantiles = lower + (upper - lower) * (position - below)
    return np.vstack([rows[:, 0], rows[:, -1], mean, std, quantiles.T])


def pooled(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the statistics over several episodes from those of each, as lerobot does; quantiles are estimates."""
    known = [key for key in layout.STORED_STATISTICS if all(part.get(key) is not None for part in parts)]
    if not parts or not {*known} >= {"count", "min", "max", "mean", "std"}:
        return {}
    values = {key: np.array([part[key] for part in parts], float) for key in known}
    count = values["count"].reshape(-1, *([1] * (values["mean"].ndim - 1)))
    found = {key: (value * count).sum(axis=0) / count.sum() for key, value in values.items()}
    spread = values["std"] ** 2 + (values["mean"] - found["mean"]) ** 2
    found |= {"min": values["min"].min(axis=0), "max": values["max"].max(axis=0)}
    found |= {"std": np.sqrt((spread * count).sum(axis=0) / count.sum())}
    return {key: value.tolist() for key, value in found.items()} | {"count": [int(values["count"].sum())]}


def side_by_side[C: (Column, PlainColumn)](columns: Iterable[C]) -> Iterator[tuple[C, slice]]:
    """Yield each of `columns` with the slice of its values, where those of all stand side by side."""
    first = 0
    for column in columns:
        yield column, slice(first, first + column.size)
        first += column.size


def ranges(blocks: Iterable[Mapping[str, Array]]) -> dict[str, dict[str, Any]]:
    """Return count, min, max, mean and std of each index of the columns in `blocks`, each (n,) or (n, size)."""
    found: dict[str, dict[str, Any]] = {}
    for block in blocks:
        for name, values in block.items():
            table = as_rows(values).astype(np.float64)
            part = {kind: getattr(table, kind)(axis=0) for kind in ("min", "max", "mean", "std")}
            part |= {"count": [len(table)]}
            found[name] = pooled([found[name], part] if name in found else [part])
    return found


class EpisodeRows:
    """Writes meta/episodes, one row per `append`."""

    def __init__(self, root: Path, columns: list[Column], task: str, cameras: Mapping[str, Mapping[str, Any]]) -> None:
        self._columns, self._task, self._schema = columns, task, layout.episodes_schema(columns, cameras)
        self.pictures: list[Mapping[str, Any]] = []
        kept = [f"stats/{column.name}/{name}.list.element" for column in columns for name in layout.STATISTICS]
        encodings = dict.fromkeys(kept, "BYTE_STREAM_SPLIT")
        self.file = layout.RotatingWriter(root, layout.EPISODES_PATH, self._schema, encodings, "zstd")
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
        self.file.close()

    def statistics(self) -> dict[str, dict[str, list[Any]]]:
        """Return those of all episodes that were written, by column, as in meta/stats.json."""
        return {
            column.name: {key: values if key == "count" else values[part] for key, values in self._total.items()}
            for column, part in side_by_side(self._columns)
        }

    def _flush(self) -> None:
        count = len(self._rows)
        chunk, file = self.file.locate()
        lengths, chunks, files = np.array(self._rows, dtype=np.int64).T
        ends = self._frames + np.cumsum(lengths)
        episodes = np.arange(self._episodes, self._episodes + count)
        rows: list[Array] = [lengths, chunks, files, ends - lengths, ends]
        arrays = [layout.to_arrow(episodes), pa.array([[self._task]] * count), *map(layout.to_arrow, rows)]
        counted = zip(self._statistics, lengths[:, None], strict=True)
        parts = [dict(zip(layout.STATISTICS, one, strict=True)) | {"count": steps} for one, steps in counted]
        self._total = pooled([self._total, *parts] if self._total else parts)
        stacked = np.stack(self._statistics)
        for column, part in side_by_side(self._columns):
            if column.dtype == "float32":  # more digits would take more room than the values of short episodes
                stacked[:, :, part] = stacked[:, :, part].astype(np.float32)
            for name in layout.STORED_STATISTICS:
                values = lengths[:, None] if name == "count" else stacked[:, layout.STATISTICS.index(name), part]
                arrays.append(layout.to_arrow(values))
        for field in self._schema.names[len(arrays) : -2]:
            known = (one.get(field) for one in self.pictures[self._episodes : self._episodes + count])
            arrays.append(pa.array(known, self._schema.field(field).type))
        arrays += [layout.to_arrow(np.full(count, chunk)), layout.to_arrow(np.full(count, file))]
        self.file.write(pa.Table.from_arrays(arrays, self._schema.names).cast(self._schema))
        self._episodes += count
        self._frames = int(ends[-1])
        self._rows.clear()
        self._statistics.clear()
