import json
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_dataset import COLUMNS, LENGTHS

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset import Dataset
from astra_data.dataset import format as layout
from astra_data.dataset.columns import ACTION, REWARD, STATE, Array
from astra_data.dataset.format import read_blocks, to_arrow, to_numpy
from astra_data.dataset.frames import Frames

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def test_constants_are_lerobots(lerobot: SimpleNamespace) -> None:
    files = lerobot.files
    assert layout.CODEBASE_VERSION == lerobot.package.CODEBASE_VERSION
    assert layout.CHUNK_SIZE == files.DEFAULT_CHUNK_SIZE
    assert layout.DATA_FILE_SIZE_MB == files.DEFAULT_DATA_FILE_SIZE_IN_MB
    assert layout.FILE_SIZE_LIMIT == files.DEFAULT_DATA_FILE_SIZE_IN_MB * 1024**2
    assert layout.VIDEO_FILE_SIZE_MB == files.DEFAULT_VIDEO_FILE_SIZE_IN_MB
    assert (layout.INFO_PATH, layout.STATS_PATH) == (files.INFO_PATH, files.STATS_PATH)
    assert layout.TASKS_PATH == files.DEFAULT_TASKS_PATH and layout.EPISODES_PATH == files.DEFAULT_EPISODES_PATH
    assert layout.DATA_PATH == files.DEFAULT_DATA_PATH and list(layout.QUANTILES) == lerobot.package.DEFAULT_QUANTILES
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
    assert info.to_dict() == fake.info and set(asdict(info)) - set(fake.info) == {"tools"}


@pytest.fixture(scope="module")
def reference(lerobot: SimpleNamespace, fake: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same values, written by lerobot itself."""
    root = tmp_path_factory.mktemp("reference") / "set"
    columns = [*COLUMNS, layout.EPISODE_UID_COLUMN]
    features = {column.name: column.feature() | {"shape": (column.size,)} for column in columns}
    written = lerobot.dataset.LeRobotDataset.create("a/b", 20, features, root=root, use_videos=False)
    for episode in fake.episodes():
        for frame in range(len(episode)):
            values = {name: np.atleast_1d(column[frame]) for name, column in episode.columns.items()}
            written.add_frame({**values, "episode_uid": np.array([episode.uid]), "task": "run"})
        written.save_episode()
    written.finalize()
    return root


def test_files_equal_those_that_lerobot_writes(fake: Dataset, reference: Path) -> None:
    def strip(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [{key: row[key] for key in row if not key.startswith("stats/")} for row in rows]

    assert json.loads((reference / "meta/info.json").read_text()) == fake.info
    for name in ("data", "meta/episodes"):
        path = f"{name}/chunk-000/file-000.parquet"
        ours, theirs = pq.read_table(fake.root / path), pq.read_table(reference / path)
        assert ours.schema.remove_metadata().equals(theirs.schema.remove_metadata().empty_table().schema)
        assert strip(ours.to_pylist()) == strip(theirs.to_pylist())
    theirs, ours = (pq.read_table(root / "meta/tasks.parquet").to_pandas() for root in (reference, fake.root))
    assert ours.equals(theirs) and ours.index.name == theirs.index.name == "task"


def test_statistics_agree_with_lerobots_where_its_own_are_exact(fake: Dataset, reference: Path) -> None:
    ours, theirs = (json.loads((root / "meta/stats.json").read_text()) for root in (fake.root, reference))
    assert set(ours) == set(theirs)
    for name, stats in theirs.items():
        assert set(stats) == set(ours[name])
        for key in ("min", "max", "mean", "count"):
            np.testing.assert_allclose(ours[name][key], stats[key], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(ours[ACTION]["std"], theirs[ACTION]["std"], rtol=1e-4)


def test_lerobots_loader_sees_every_value(lerobot: SimpleNamespace, fake: Dataset) -> None:
    loaded = lerobot.dataset.LeRobotDataset("a/b", root=fake.root, video_backend="pyav")
    assert (loaded.num_episodes, loaded.num_frames, loaded.fps) == (len(LENGTHS), sum(LENGTHS), 20)
    ours = fake.columns(list(fake.features))
    items = [loaded[index] for index in range(len(loaded))]
    assert {item["task"] for item in items} == {"run"}
    for name, values in ours.items():
        np.testing.assert_array_equal(np.stack([item[name].numpy() for item in items]), values)
    assert loaded.meta.features[STATE]["astra"]["role"] == ["position", "position", "heading"]


def test_windows_are_lerobots(lerobot: SimpleNamespace, fake: Dataset) -> None:
    episodes = [1, 2, 4]
    names = (STATE, ACTION, REWARD)
    deltas = {name: [offset / 20 for offset in (-2, -1, 0, 1, 2, 3)] for name in names}
    loaded = lerobot.dataset.LeRobotDataset(
        "a/b", root=fake.root, episodes=episodes, delta_timestamps=deltas, video_backend="pyav"
    )
    windows = Frames.load(fake, names, episodes=episodes).windows(6, padding="edge", past=2)
    assert len(windows) == len(loaded)
    for index in range(len(loaded)):
        item, window = loaded[index], windows[index]
        for name in names:
            np.testing.assert_array_equal(window[name].numpy(), item[name].numpy())
            np.testing.assert_array_equal(window["is_pad"].numpy(), item[f"{name}_is_pad"].numpy())


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        (np.array([0.5, -1.0, 3.0], np.float32), pa.float32()),
        (np.array([2**40, -1], np.int64), pa.int64()),
        (np.array([True, False, True]), pa.bool_()),
        (np.arange(12, dtype=np.float32).reshape(4, 3), pa.list_(pa.float32(), 3)),
        (np.array([[True, False], [False, False]]), pa.list_(pa.bool_(), 2)),
    ],
)
def test_values_go_to_arrow_and_back(values: Array, kind: pa.DataType) -> None:
    column = to_arrow(values)
    assert (column.type, column.to_pylist()) == (kind, values.tolist())
    chunks = pa.chunked_array([column[:1], column[1:]])
    size = values.shape[1] if values.ndim > 1 else 1
    back = to_numpy(chunks, size, values.dtype.name)
    assert back.dtype == values.dtype and back.flags.c_contiguous
    np.testing.assert_array_equal(back, values)


@pytest.mark.parametrize(
    ("rows", "kind", "size"),
    [
        ([1.0, None], pa.float32(), 1),
        ([[1.0, 2.0], [3.0, None]], pa.list_(pa.float32(), 2), 2),
        ([[1.0, 2.0], [3.0]], pa.list_(pa.float32()), 2),
    ],
)
def test_missing_values_are_refused(rows: list[object], kind: pa.DataType, size: int) -> None:
    with pytest.raises(CorruptDatasetError, match=f"expected {size} values in every row"):
        to_numpy(pa.chunked_array([pa.array(rows, kind)]), size, "float32")


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    """Two files of the numbers 0 to 9 and 10 to 14, in row groups of 4."""
    paths = [tmp_path / "a.parquet", tmp_path / "b.parquet"]
    for path, numbers in zip(paths, (range(10), range(10, 15)), strict=True):
        pq.write_table(pa.table({"x": numbers, "y": numbers}), path, row_group_size=4)
    return paths


@pytest.mark.parametrize(
    ("block_rows", "blocks"), [(1, [4, 4, 2, 4, 1]), (5, [8, 2, 5]), (8, [8, 2, 5]), (100, [10, 5])]
)
def test_blocks_are_whole_row_groups_of_one_file(
    paths: list[Path], monkeypatch: pytest.MonkeyPatch, block_rows: int, blocks: list[int]
) -> None:
    monkeypatch.setattr(layout, "BLOCK_ROWS", block_rows)
    tables = list(read_blocks(paths))
    assert [len(table) for table in tables] == blocks
    assert [x for table in tables for x in table.column("x").to_pylist()] == list(range(15))


@pytest.mark.parametrize("block_rows", [1, 5, 100])
def test_only_wanted_rows_are_read(paths: list[Path], monkeypatch: pytest.MonkeyPatch, block_rows: int) -> None:
    monkeypatch.setattr(layout, "BLOCK_ROWS", block_rows)
    for rows in ([], [0], [3, 4], [9, 10], [14], [*range(15)]):
        tables = list(read_blocks(paths, ["x"], np.isin(np.arange(15), rows)))
        assert [x for table in tables for x in table.column("x").to_pylist()] == rows
        assert all(table.column_names == ["x"] for table in tables)
