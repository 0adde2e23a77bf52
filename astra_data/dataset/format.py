"""The LeRobot v3.0 format: the rules that lerobot 0.6.1 keeps in code, whose import is slow; a test compares them.

Then parquet files: numpy columns in and out, and a writer that starts a new file when one is full.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.arrays import Bools, Ints
from astra_data.core.errors import CorruptDatasetError, in_short
from astra_data.dataset import columns as keys
from astra_data.dataset.columns import Array, Column

CODEBASE_VERSION = "v3.0"
CHUNK_SIZE = 1000  # files per chunk folder
DATA_FILE_SIZE_MB = 100
VIDEO_FILE_SIZE_MB = 200
INFO_PATH = "meta/info.json"
STATS_PATH = "meta/stats.json"
TASKS_PATH = "meta/tasks.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
VIDEO_PLACE = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"

OUR_FOLDER = "meta/astra"
DATASET_PATH = f"{OUR_FOLDER}/dataset.json"
METADATA_PATH = f"{OUR_FOLDER}/episodes.parquet"
SUBSETS_PATH = f"{OUR_FOLDER}/subsets.json"
DIGESTS_PATH = f"{OUR_FOLDER}/digests.parquet"
POLICY_PATH = f"{OUR_FOLDER}/policy.safetensors"
METADATA_KEYS = ("episode_uid", "length")  # first columns of `METADATA_PATH`; the others are the episodes' own metadata

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
STATISTICS = ("min", "max", "mean", "std", "q01", "q10", "q50", "q90", "q99")
STORED_STATISTICS = ("min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99")  # in LeRobot's order

_INDICES = (keys.FRAME_INDEX, keys.EPISODE_INDEX, keys.INDEX, keys.TASK_INDEX)
DEFAULT_COLUMNS = (Column(keys.TIMESTAMP), *(Column(name, "int64") for name in _INDICES))
EPISODE_UID_COLUMN = Column(keys.EPISODE_UID, "int64", meaning="names the episode for good")

_ENCODINGS = {"float32": "BYTE_STREAM_SPLIT", "int64": "DELTA_BINARY_PACKED"}


def stored_columns(columns: Sequence[Column]) -> list[Column]:
    """Return all columns of a dataset in the order of the file: the given ones, the uid, LeRobot's own."""
    return [*columns, EPISODE_UID_COLUMN, *DEFAULT_COLUMNS]


def reserved_values(steps: int, *, uid: int, episode: int, start: int, fps: float) -> dict[str, Array]:
    """Return uid and LeRobot's own columns of an episode of `steps` from index `start`, (T,) each, in file order."""
    frames = np.arange(steps)
    return {
        keys.EPISODE_UID: np.full(steps, uid),
        keys.TIMESTAMP: frames / fps,
        keys.FRAME_INDEX: frames,
        keys.EPISODE_INDEX: np.full(steps, episode),
        keys.INDEX: frames + start,
        keys.TASK_INDEX: np.zeros_like(frames),
    }


def arrow_type(dtype: str, size: int) -> pa.DataType:
    """Return the type of one step of `size` values of numpy's `dtype`: a scalar, or a list of fixed size."""
    value = pa.from_numpy_dtype(np.dtype(dtype))
    return value if size == 1 else pa.list_(value, size)


def data_schema(columns: Sequence[Column], images: Sequence[str] = ()) -> pa.Schema:
    """Return the Arrow schema of the data files, with the metadata that HF datasets reads."""
    features: dict[str, Any] = {}
    for column in columns:
        value = {"dtype": column.dtype, "_type": "Value"}
        listed = {"feature": value, "length": column.size, "_type": "List"}
        features[column.name] = value if column.size == 1 else listed
    features |= {name: {"_type": "Image"} for name in images}
    metadata = {"huggingface": json.dumps({"info": {"features": features}})}
    fields = [(column.name, arrow_type(column.dtype, column.size)) for column in columns]
    return pa.schema([*fields, *((name, IMAGE) for name in images)], metadata=metadata)


def data_encodings(columns: Sequence[Column]) -> dict[str, str]:
    """Return the parquet encoding of each column by its path in the file; a third smaller than LeRobot's."""
    return {
        column.name if column.size == 1 else f"{column.name}.list.element": _ENCODINGS[column.dtype]
        for column in columns
        if column.dtype in _ENCODINGS
    }


def episodes_schema(columns: Sequence[Column], cameras: Mapping[str, Mapping[str, Any]]) -> pa.Schema:
    """Return the Arrow schema of meta/episodes; `cameras` are the features of cameras."""
    places = ("length", "data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index")
    fields: list[tuple[str, pa.DataType]] = [("episode_index", pa.int64()), ("tasks", pa.list_(pa.string()))]
    fields += [(name, pa.int64()) for name in places]
    for column in columns:
        for name in STORED_STATISTICS:
            value = pa.int64() if name == "count" else pa.float64()
            fields.append((f"stats/{column.name}/{name}", pa.list_(value)))
    for name, feature in cameras.items():
        if feature["dtype"] == "video":
            fields += [(f"videos/{name}/{key}", pa.int64()) for key in VIDEO_PLACE[:2]]
            fields += [(f"videos/{name}/{key}", pa.float64()) for key in VIDEO_PLACE[2:]]
        nested = pa.list_(pa.list_(pa.list_(pa.float64())))
        fields += [
            (f"stats/{name}/{key}", pa.list_(pa.int64()) if key == "count" else nested) for key in STORED_STATISTICS
        ]
    fields += [("meta/episodes/chunk_index", pa.int64()), ("meta/episodes/file_index", pa.int64())]
    return pa.schema(fields)


def tasks_table(task: str) -> pa.Table:
    """Return meta/tasks.parquet: a pandas frame with one row, the task as its index."""
    text = {"pandas_type": "unicode", "numpy_type": "object"}
    number = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [{"name": None, "field_name": None, **text, "metadata": {"encoding": "UTF-8"}}],
        "columns": [
            {"name": "task_index", "field_name": "task_index", **number},
            {"name": "task", "field_name": "task", **text, "metadata": None},
        ],
        "attributes": {},
        "pandas_version": "2.3.3",
    }
    schema = pa.schema([("task_index", pa.int64()), ("task", pa.string())], metadata={"pandas": json.dumps(pandas)})
    return pa.table({"task_index": [0], "task": [task]}, schema=schema)


def dataset_info(
    columns: Sequence[Column], cameras: Mapping[str, Mapping[str, Any]], *, fps: int, episodes: int, frames: int
) -> dict[str, Any]:
    """Return meta/info.json; `cameras` are the features of cameras."""
    return {
        "codebase_version": CODEBASE_VERSION,
        "fps": fps,
        "features": {**{column.name: column.feature() for column in columns}, **cameras},
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": CHUNK_SIZE,
        "data_files_size_in_mb": DATA_FILE_SIZE_MB,
        "video_files_size_in_mb": VIDEO_FILE_SIZE_MB,
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if any(it["dtype"] == "video" for it in cameras.values()) else None,
        "robot_type": None,
        "splits": {"train": f"0:{episodes}"},
    }


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
    bits = dtype == "bool"  # through DLPack, because Arrow's own to_numpy imports pandas; DLPack has no packed bits
    numeric = (pa.types.is_integer, pa.types.is_floating)
    if not all(pa.types.is_boolean(p.type) if bits else any(k(p.type) for k in numeric) for p in parts):
        raise CorruptDatasetError(f"expected {dtype}, got {column.type}")
    values = [np.from_dlpack(part.cast(pa.uint8()) if bits else part) for part in parts]
    flat: Array = np.concatenate(values).astype(dtype, copy=False)
    return flat if size == 1 else flat.reshape(-1, size)


def open_parquet(path: Path) -> pq.ParquetFile:
    """Open the parquet file at `path`, which is closed by `with`; altered pages that have a sum raise when read."""
    if path.exists() and not path.is_file():
        raise OSError("it is a folder, a device or a pipe, expected a file")
    file = pq.ParquetFile(path, page_checksum_verification=True)
    listed = file.schema_arrow.names
    if doubled := sorted({name for name in listed if listed.count(name) > 1}):
        file.close()
        raise ValueError(f"it has the column {', '.join(doubled)} more than once")
    return file


def read_blocks(
    paths: Sequence[Path], names: Sequence[str] | None = None, wanted: Bools | None = None, most: int = BLOCK_VALUES
) -> Iterator[pa.Table]:
    """Yield the columns `names`, by default all, of files in order, in blocks of `wanted` row groups, `most` rows."""
    end, enough = 0, min(most, BLOCK_ROWS)
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


class RotatingWriter:
    """Writes tables as row groups, and starts the next file once one has reached `FILE_SIZE_LIMIT`."""

    def __init__(self, root: Path, pattern: str, schema: pa.Schema, encodings: Mapping[str, str], packing: str) -> None:
        """Start the first file; `pattern` names the files, `encodings` those of their columns, `packing` of pages."""
        self._number = 0  # of the file
        self._root, self._pattern, self._schema = root, pattern, schema
        self._options = {"compression": packing, "use_dictionary": False, "column_encoding": encodings}
        self._options["write_page_checksum"] = IMAGE in schema.types  # of numbers, each episode has a digest
        self._open()

    def _open(self) -> None:
        chunk, file = divmod(self._number, CHUNK_SIZE)
        path = self._root / self._pattern.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("wb")
        self._writer = pq.ParquetWriter(self._file, self._schema, **self._options)

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
