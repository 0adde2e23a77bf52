import shutil
from pathlib import Path
from types import SimpleNamespace

import datasets
import numpy as np
import pyarrow.parquet as pq
import pytest

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.columns import ACTION, STATE
from astra_data.dataset.reader import Dataset

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning"),
    pytest.mark.usefixtures("lerobot"),  # its cache, and no network
]


def test_the_rows_are_those_of_lerobots_object(fake: Dataset, lerobot: SimpleNamespace) -> None:
    rows, opened = fake.to_huggingface(), fake.to_lerobot()
    assert isinstance(rows, datasets.Dataset)
    assert isinstance(opened, lerobot.dataset.LeRobotDataset)
    assert rows.features == opened.hf_dataset.features
    assert rows.with_format("arrow")[:].equals(opened.hf_dataset.with_format("arrow")[:])
    for name, values in fake.columns(list(rows.features)).items():
        np.testing.assert_array_equal(np.array(rows[:][name]), values)
    assert (opened.num_episodes, len(opened)) == (len(fake), len(rows))


def test_options_are_lerobots(fake: Dataset) -> None:
    opened = fake.to_lerobot(delta_timestamps={STATE: [-0.05, 0.0]})
    np.testing.assert_array_equal(opened[1][STATE].numpy(), fake.columns([STATE])[STATE][:2])


def test_altered_values_are_not_handed_on(fake: Dataset, tmp_path: Path) -> None:
    root = shutil.copytree(fake.root, tmp_path / "altered")
    path = root / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    moved = table.column(ACTION).combine_chunks().take([len(table) - 1, *range(len(table) - 1)])
    pq.write_table(table.set_column(table.schema.get_field_index(ACTION), table.field(ACTION), moved), path)
    altered = Dataset.open(root)
    for convert in (altered.to_huggingface, altered.to_lerobot):
        with pytest.raises(CorruptDatasetError):
            convert()


def test_nothing_is_written(fake: Dataset, tmp_path: Path) -> None:
    root = shutil.copytree(fake.root, tmp_path / "copy")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    rows = Dataset.open(root).to_huggingface()
    assert rows.cache_files == []
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
