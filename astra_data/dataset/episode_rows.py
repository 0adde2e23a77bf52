"""meta/episodes: location and statistics of each episode, one row per episode."""

from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from astra_data.dataset.column_statistics import side_by_side
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.format import EPISODES_PATH, STATISTICS, STORED_STATISTICS, episodes_schema
from astra_data.dataset.parquet import RotatingWriter, to_lists

ROWS_AT_ONCE = 1000
"""Rows held in memory before they are written."""


class EpisodeRows:
    """Writes meta/episodes, one row per `append`."""

    def __init__(self, root: Path, columns: list[Column], task: str) -> None:
        """Start for a dataset in `root` with the stored `columns` and one `task`."""
        self._columns = columns
        self._task = task
        self._schema = episodes_schema(columns)
        self._writer = RotatingWriter(root, EPISODES_PATH, self._schema)
        self._rows: list[tuple[int, int, int]] = []
        self._statistics: list[NDArray[np.float64]] = []
        self._episodes = 0
        self._frames = 0

    def append(self, length: int, chunk: int, file: int, statistics: NDArray[np.float64]) -> None:
        """Append an episode of `length` steps in data file `file` of `chunk`.

        `statistics` are those of all columns side by side, (9, sum of the columns' sizes).
        """
        self._rows.append((length, chunk, file))
        self._statistics.append(statistics)
        if len(self._rows) == ROWS_AT_ONCE:
            self._flush()

    def close(self) -> None:
        """Write the remaining rows and the footer."""
        if self._rows:
            self._flush()
        self._writer.close()

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
        arrays = [pa.array(episodes), pa.array([[self._task]] * count), *map(pa.array, rows)]
        stacked = np.stack(self._statistics)
        for _, part in side_by_side(self._columns):
            for name in STORED_STATISTICS:
                values = lengths[:, None] if name == "count" else stacked[:, STATISTICS.index(name), part]
                arrays.append(to_lists(values))
        arrays += [pa.array(np.full(count, chunk)), pa.array(np.full(count, file))]
        self._writer.write(pa.Table.from_arrays(arrays, schema=self._schema))
        self._episodes += count
        self._frames = int(ends[-1])
        self._rows.clear()
        self._statistics.clear()
