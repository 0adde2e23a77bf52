"""The LeRobot v3.0 format: the rules that lerobot 0.6.1 keeps in code, whose import is slow; a test compares them."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

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

DEFAULT_COLUMNS = (
    Column(keys.TIMESTAMP),
    Column(keys.FRAME_INDEX, "int64"),
    Column(keys.EPISODE_INDEX, "int64"),
    Column(keys.INDEX, "int64"),
    Column(keys.TASK_INDEX, "int64"),
)
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
    fields: list[tuple[str, pa.DataType]] = [
        ("episode_index", pa.int64()),
        ("tasks", pa.list_(pa.string())),
        ("length", pa.int64()),
        ("data/chunk_index", pa.int64()),
        ("data/file_index", pa.int64()),
        ("dataset_from_index", pa.int64()),
        ("dataset_to_index", pa.int64()),
    ]
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
