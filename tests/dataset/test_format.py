"""What we write, seen by lerobot: its loader opens it, and the constants that we repeat are its own."""

import json
from dataclasses import asdict
from types import SimpleNamespace

import pyarrow.parquet as pq
import pytest
from fake_dataset import COLUMNS

from astra_data.dataset import format as layout
from astra_data.dataset import parquet
from astra_data.dataset.reader import Dataset

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def test_constants_are_lerobots(lerobot: SimpleNamespace) -> None:
    files = lerobot.files
    assert layout.CODEBASE_VERSION == lerobot.package.CODEBASE_VERSION
    assert layout.CHUNK_SIZE == files.DEFAULT_CHUNK_SIZE
    assert layout.DATA_FILE_SIZE_MB == files.DEFAULT_DATA_FILE_SIZE_IN_MB
    assert parquet.FILE_SIZE_LIMIT == files.DEFAULT_DATA_FILE_SIZE_IN_MB * 1024**2
    assert layout.VIDEO_FILE_SIZE_MB == files.DEFAULT_VIDEO_FILE_SIZE_IN_MB
    assert (layout.INFO_PATH, layout.STATS_PATH) == (files.INFO_PATH, files.STATS_PATH)
    assert layout.TASKS_PATH == files.DEFAULT_TASKS_PATH
    assert layout.EPISODES_PATH == files.DEFAULT_EPISODES_PATH
    assert layout.DATA_PATH == files.DEFAULT_DATA_PATH
    assert list(layout.QUANTILES) == lerobot.package.DEFAULT_QUANTILES
    defaults = {c.name: c.feature() | {"shape": (c.size,)} for c in layout.DEFAULT_COLUMNS}
    assert defaults == lerobot.names.DEFAULT_FEATURES


def test_the_columns_of_lerobot_come_in_the_order_of_the_file() -> None:
    values = layout.reserved_values(3, uid=7, episode=2, start=10, fps=4)
    assert list(values) == [column.name for column in layout.stored_columns([])]
    assert {name: column.tolist() for name, column in values.items()} == {
        "episode_uid": [7, 7, 7],
        "timestamp": [0.0, 0.25, 0.5],
        "frame_index": [0, 1, 2],
        "episode_index": [2, 2, 2],
        "index": [10, 11, 12],
        "task_index": [0, 0, 0],
    }
    assert values["timestamp"].dtype == "float64"


def test_the_arrow_schema_is_lerobots(lerobot: SimpleNamespace) -> None:
    stored = layout.stored_columns(COLUMNS)
    features = {column.name: column.feature() | {"shape": (column.size,)} for column in stored}
    expected = lerobot.features.get_hf_features_from_features(features).arrow_schema
    ours = layout.data_schema(stored)
    assert ours.remove_metadata().equals(expected.remove_metadata())
    assert json.loads(ours.metadata[b"huggingface"]) == json.loads(expected.metadata[b"huggingface"])


def test_info_has_lerobots_fields(lerobot: SimpleNamespace, fake: Dataset) -> None:
    info = lerobot.files.DatasetInfo.from_dict(json.loads((fake.root / "meta/info.json").read_text()))
    assert info.to_dict() == fake.info
    assert set(asdict(info)) - set(fake.info) == {"tools"}


def test_encodings_are_keyed_by_the_paths_in_the_file(fake: Dataset) -> None:
    row_group = pq.read_metadata(fake.paths[0]).row_group(0)
    chunks = [row_group.column(index) for index in range(row_group.num_columns)]
    stored = {chunk.path_in_schema: chunk.encodings for chunk in chunks}
    encodings = layout.data_encodings(layout.stored_columns(COLUMNS))
    assert all(encoding in stored[path] for path, encoding in encodings.items())
    assert stored.keys() - encodings.keys() == {column.name for column in COLUMNS if column.dtype == "bool"}


def test_the_tasks_table_is_a_pandas_frame_with_the_task_as_index() -> None:
    frame = layout.tasks_table("walk").to_pandas()
    assert (frame.index.name, frame.index.tolist()) == ("task", ["walk"])
    assert frame["task_index"].tolist() == [0]
