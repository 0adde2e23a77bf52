"""Is a dataset whole? Counts and schemas when it is opened, every value when it is verified."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from astra_data.dataset import columns as names
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.description import ContentHash
from astra_data.dataset.format import arrow_type
from astra_data.dataset.parquet import UNREADABLE, first_line, read_blocks, to_numpy

Ints = NDArray[np.int64]


def file_faults(root: Path, columns: Sequence[Column], rows: dict[Path, int]) -> Iterator[str]:
    """List what is wrong with the data files, from their footers.

    Args:
        root: the dataset's folder.
        columns: all stored columns.
        rows: each data file that should be there and its number of rows.
    """
    for path in sorted(set((root / "data").glob("*/*.parquet")) - set(rows)):
        yield f"{path.relative_to(root)} does not belong to it"
    for path, expected in rows.items():
        name = path.relative_to(root)
        try:
            with pq.ParquetFile(path) as file:
                found, schema = file.metadata.num_rows, file.schema_arrow
        except FileNotFoundError:
            yield f"{name} is missing"
            continue
        except UNREADABLE as error:
            yield f"{name} is truncated or no parquet file ({first_line(error)})"
            continue
        if found != expected:
            yield f"{name} has {found} rows, expected {expected}"
        for key in sorted(set(schema.names) - {column.name for column in columns}):
            yield f"{name} has an unknown column {key}"
        for column in columns:
            if column.name not in schema.names:
                yield f"{name} lacks column {column.name}"
            elif (kind := schema.field(column.name).type) != arrow_type(column):
                yield f"{name} has {column.name} as {kind}, expected {arrow_type(column)}"


def content_faults(
    paths: Sequence[Path], columns: Sequence[Column], *, fps: int, starts: Ints, uids: Ints, content_hash: str
) -> Iterator[str]:
    """List what is wrong with the values, reading every file once.

    Args:
        paths: the data files in order.
        columns: all stored columns.
        fps: steps per second.
        starts: first row of each episode, (E,).
        uids: their uids, (E,).
        content_hash: the hash that the values should have.
    """
    running = ContentHash()
    rows = 0
    told: set[str] = set()
    for table in read_blocks(paths, [column.name for column in columns]):
        values = {c.name: to_numpy(table.column(c.name), c.size, c.dtype) for c in columns}
        index = np.arange(rows, rows + table.num_rows)
        rows += table.num_rows
        episode = np.searchsorted(starts, index, side="right") - 1
        frame = index - starts[episode]
        expected: dict[str, Array] = {
            names.INDEX: index,
            names.EPISODE_INDEX: episode,
            names.FRAME_INDEX: frame,
            names.TIMESTAMP: (frame / fps).astype(np.float32),
            names.TASK_INDEX: np.zeros_like(index),
            names.EPISODE_UID: uids[episode],
        }
        for name, array in values.items():
            running.update(name, array)
            wrong = ~np.isfinite(array) if array.dtype.kind == "f" else np.zeros(array.shape, dtype=bool)
            if name in expected:
                wrong |= array != expected[name]
            if wrong.any() and name not in told:
                told.add(name)
                at = np.argwhere(wrong)[0][0]
                yield f"{name} has a wrong value in episode {episode[at]} frame {frame[at]}"
    if running.hexdigest() != content_hash:
        yield f"the content hash is {running.hexdigest()}, expected {content_hash}"
    if len(np.unique(uids)) < len(uids):
        yield "two episodes have the same uid"
