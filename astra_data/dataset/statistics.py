"""Exact statistics in float64, with LeRobot's names and shapes."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.columns import Array, Column
from astra_data.dataset.format import QUANTILES, STATISTICS, STORED_STATISTICS

BLOCK_VALUES = 2**24
"""Values of a column that are held in memory as float64 at once: 128 MiB."""


def statistics(values: Array) -> NDArray[np.float64]:
    """Return `STATISTICS` (9, size) of `values` (T, size); quantiles are linearly interpolated."""
    # One contiguous row per index: sums are then pairwise and sorting is fast.
    rows = np.ascontiguousarray(values.T, dtype=np.float64)
    mean = rows.mean(axis=1)
    centred = rows - mean[:, None]
    np.square(centred, out=centred)
    std = np.sqrt(centred.mean(axis=1))
    rows.sort(axis=1)
    position = np.array(QUANTILES) * (rows.shape[1] - 1)
    below = np.floor(position).astype(np.intp)
    lower, upper = rows[:, below], rows[:, np.ceil(position).astype(np.intp)]
    quantiles = lower + (upper - lower) * (position - below)
    return np.vstack([rows[:, 0], rows[:, -1], mean, std, quantiles.T])


def global_statistics(
    columns: list[Column], frames: int, blocks: Callable[[str], Iterator[Array]]
) -> dict[str, dict[str, list[Any]]]:
    """Return meta/stats.json over all `frames`.

    Args:
        columns: all stored columns.
        frames: number of rows.
        blocks: yields the values (n, size) of the named column from the first row to the last.
    """
    stats: dict[str, dict[str, list[Any]]] = {}
    for column in columns:
        width = min(column.size, max(1, BLOCK_VALUES // frames))
        parts = []
        for first in range(0, column.size, width):
            last = min(first + width, column.size)
            values = np.empty((frames, last - first), dtype=column.dtype)
            row = 0
            for block in blocks(column.name):
                values[row : row + len(block)] = block.reshape(len(block), -1)[:, first:last]
                row += len(block)
            parts.append(statistics(values))
        named = dict(zip(STATISTICS, np.concatenate(parts, axis=1).tolist(), strict=True))
        stats[column.name] = {name: named.get(name, [frames]) for name in STORED_STATISTICS}
    return stats
