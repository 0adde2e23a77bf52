"""Parquet files: numpy columns in and out, and a writer that starts a new file when one is full."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.arrays import Bools, Ints
from astra_data.core.errors import CorruptDatasetError, in_short
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.format import CHUNK_SIZE, DATA_FILE_SIZE_MB

FILE_SIZE_LIMIT = DATA_FILE_SIZE_MB * 2**20
UNREADABLE = (OSError, ValueError, pa.ArrowException)  # of damaged files; ValueError: names are not valid UTF-8
GROUP_ROWS = 2**12  # upper bound of the rows of a row group of several episodes: the footer names all its columns
BLOCK_ROWS = 2**14  # rows read at once, rounded up to whole row groups
BLOCK_VALUES = 2**23  # values of arrays that are read at once, where that is fewer rows; rounded up, too


def to_arrow(values: Array) -> pa.Array:
    """Return `values` (T,) or (T, size) as an Arrow array of their type; only bools are copied."""
    if values.ndim > 1:
        return pa.FixedSizeListArray.from_arrays(to_arrow(values.reshape(-1)), values.shape[1])
    # As buffers, because Arrow's own conversion imports pandas.
    data = np.packbits(values, bitorder="little") if values.dtype == bool else np.ascontiguousarray(values)
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(data)])


def to_numpy(column: pa.ChunkedArray, size: int, dtype: str) -> Array:
    """Copy an Arrow column of n rows to a contiguous array (n,), or (n, size) if `size` > 1."""
    parts = [chunk.flatten() if size > 1 else chunk for chunk in column.chunks]
    if any(part.null_count for part in parts) or sum(map(len, parts)) != len(column) * size:
        raise CorruptDatasetError(f"expected {size} values in every row, some are missing")
    # Through DLPack, because Arrow's own to_numpy imports pandas; DLPack has no packed bits.
    bits = dtype == "bool"
    numeric = (pa.types.is_integer, pa.types.is_floating)
    if not all(pa.types.is_boolean(p.type) if bits else any(k(p.type) for k in numeric) for p in parts):
        raise CorruptDatasetError(f"expected {dtype}, got {column.type}")
    values = [np.from_dlpack(part.cast(pa.uint8()) if bits else part) for part in parts]
    flat: Array = np.concatenate(values).astype(dtype, copy=False)
    return flat if size == 1 else flat.reshape(-1, size)


def open_parquet(path: Path) -> pq.ParquetFile:
    """Open the parquet file at `path`, which is closed by `with`."""
    if path.exists() and not path.is_file():
        raise OSError("it is a folder, a device or a pipe, expected a file")
    file = pq.ParquetFile(path)
    listed = file.schema_arrow.names
    if doubled := sorted({name for name in listed if listed.count(name) > 1}):
        file.close()
        raise ValueError(f"it has the column {', '.join(doubled)} more than once")
    return file


def read_blocks(
    paths: Sequence[Path], names: Sequence[str] | None = None, wanted: Bools | None = None, most_rows: int | None = None
) -> Iterator[pa.Table]:
    """Yield the columns `names`, by default all, of all files in order, in blocks of whole `wanted` row groups."""
    end, enough = 0, most_rows or BLOCK_ROWS
    for path in paths:
        try:
            with open_parquet(path) as file:
                metadata = file.metadata
                groups: list[int] = []
                masks: list[Bools] = []
                rows = 0
                for group in range(metadata.num_row_groups):
                    begin, end = end, end + metadata.row_group(group).num_rows
                    if wanted is None or wanted[begin:end].any():
                        groups.append(group)
                        rows += end - begin
                        masks += [] if wanted is None else [wanted[begin:end]]
                    if groups and (rows >= enough or group == metadata.num_row_groups - 1):
                        table = file.read_row_groups(groups, columns=names, use_threads=False)
                        yield table if all(mask.all() for mask in masks) else table.filter(to_arrow(np.hstack(masks)))
                        groups, masks, rows = [], [], 0
        except UNREADABLE as error:
            name = f"{path.parent.name}/{path.name}"
            raise CorruptDatasetError(f"{name} cannot be read ({in_short(error)})") from error


def rows_of(chosen: Ints, starts: Ints, lengths: Ints, total: int) -> Bools | None:
    """Return the mask (total,) of the rows of episodes `chosen`, as `read_blocks` takes it; None for all."""
    if len(chosen) == len(starts):
        return None
    wanted = np.zeros(total, dtype=bool)
    for episode in chosen:
        wanted[starts[episode] : starts[episode] + lengths[episode]] = True
    return wanted


def read_arrays(paths: Sequence[Path], columns: Sequence[Column], wanted: Bools | None) -> Iterator[dict[str, Array]]:
    """Yield the blocks of `read_blocks` as contiguous arrays by name, (n,) or (n, size)."""
    most_rows = min(BLOCK_ROWS, max(1, BLOCK_VALUES // sum(column.size for column in columns)))
    for table in read_blocks(paths, [column.name for column in columns], wanted, most_rows):
        yield {c.name: to_numpy(table.column(c.name), c.size, c.dtype) for c in columns}


class RotatingWriter:
    """Writes tables as row groups, and starts the next file once one has reached `FILE_SIZE_LIMIT`."""

    def __init__(self, root: Path, pattern: str, schema: pa.Schema, encodings: Mapping[str, str], packing: str) -> None:
        """Start the first file; `pattern` names the files, `encodings` those of their columns, `packing` of pages."""
        self._number = 0  # of the file
        self._root, self._pattern, self._schema = root, pattern, schema
        self._encodings, self._packing = encodings, packing
        self._open()

    def _open(self) -> None:
        chunk, file = divmod(self._number, CHUNK_SIZE)
        path = self._root / self._pattern.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("wb")
        self._writer = pq.ParquetWriter(
            self._file, self._schema, compression=self._packing, use_dictionary=False, column_encoding=self._encodings
        )

    def locate(self) -> tuple[int, int]:
        """Return (chunk_index, file_index) of the next row group, starting a new file if this one is full."""
        if self._file.tell() >= FILE_SIZE_LIMIT:
            self.close()
            self._number += 1
            self._open()
        return divmod(self._number, CHUNK_SIZE)

    def write(self, table: pa.Table) -> None:
        """Append `table` as one row group; call `locate` first."""
        self._writer.write_table(table, row_group_size=table.num_rows)

    def close(self) -> None:
        """Write the footer."""
        self._writer.close()
        self._file.close()

    def abandon(self) -> None:
        """Close a file that is not wanted any more; if it is closed already, do nothing."""
        with suppress(OSError):
            self._writer.close()
        self._writer.is_open = False  # or it would try again when it is collected
        with suppress(OSError):
            self._file.close()
