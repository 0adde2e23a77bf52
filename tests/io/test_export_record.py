import hashlib
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from fake_dataset import COLUMNS, write_fake
from fake_transitions import write_transitions

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset.columns import REWARD
from astra_data.dataset.reader import Dataset
from astra_data.io.export_record import Export, ExportRecord, read_record, restored
from astra_data.io.exporters import export
from astra_data.io.importers import csv, hdf5
from astra_data.io.importing import import_dataset
from astra_data.io.recording import Source


@pytest.fixture
def record(tmp_path: Path) -> dict[str, Any]:
    """The record of the fake dataset, once all its episodes were exported."""
    export = Export(write_fake(tmp_path / "set"), {column.name: column.name for column in COLUMNS})
    for _ in export.episodes():
        pass
    return json.loads(export.text())  # type: ignore[no-any-return]


def test_a_record_says_what_the_dataset_is(record: dict[str, Any], tmp_path: Path) -> None:
    dataset = write_fake(tmp_path / "again")
    read = ExportRecord.parse(json.dumps(record), "here")
    assert read.columns == list(COLUMNS)
    assert read.identity == dataset.identity
    assert list(read.uids) == dataset.uids.tolist()
    assert {key: list(facts) for key, facts in read.metadata.items()} == dataset.metadata
    values = dataset.columns([column.name for column in COLUMNS])
    assert read.sums == {name: hashlib.sha256(array.tobytes()).hexdigest() for name, array in values.items()}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"uids": [1]}, "expected as many entries in each"),
        ({"sums": {}}, "expected the same columns in all of them"),
        ({"fps": 0}, "fps: Input should be greater"),
        ({"metadata": {"return": [float("inf")]}}, "metadata"),
        ({"name": "../up"}, "name: String should match"),
        ({"more": 1}, "more: Extra inputs"),
    ],
)
def test_a_malformed_record_is_one_line(record: dict[str, Any], change: dict[str, Any], fault: str) -> None:
    with pytest.raises(CorruptDatasetError, match=fault) as caught:
        ExportRecord.parse(json.dumps(record | change), "here")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "[" * 10000, b"\xff", "null"])
def test_no_record_is_one_line(text: str | bytes) -> None:
    with pytest.raises(CorruptDatasetError, match="here: its record of the export is malformed"):
        ExportRecord.parse(text, "here")


@pytest.fixture
def source(tmp_path: Path) -> Source:
    """A D4RL file of the dataset `tmp_path / "set"`."""
    path = tmp_path / "set.hdf5"
    export(write_transitions(tmp_path / "set"), path, format="d4rl")
    return Source(path, None, path)


@pytest.mark.parametrize("rows", [3, 2**13])
def test_episodes_are_cut_as_they_were_whatever_the_blocks(
    source: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    monkeypatch.setattr(hdf5, "BLOCK_ROWS", rows)
    record = read_record(hdf5, source)
    assert record is not None
    dataset = write_transitions(tmp_path / "again")
    for found, expected in zip(restored(hdf5, source, record), dataset.episodes(), strict=True):
        assert (found.uid, found.metadata) == (expected.uid, expected.metadata)
        for name, values in expected.columns.items():
            np.testing.assert_array_equal(found.columns[name], values, err_msg=name)


def test_other_files_have_no_record(source: Source) -> None:
    assert read_record(csv, source) is None
    with h5py.File(source.path, "r+") as file:
        file.move("metadata/astra_data", "kept")
        assert read_record(hdf5, source) is None
        file["metadata/astra_data"] = h5py.SoftLink("/kept")
    assert read_record(hdf5, source) is None


def test_fields_of_another_kind_are_told(source: Source) -> None:
    record = read_record(hdf5, source)
    assert record is not None
    with h5py.File(source.path, "r+") as file:
        rewards = file["rewards"][()]
        del file["rewards"]
    with pytest.raises(BadInputError, match="no field 'rewards'"):
        list(restored(hdf5, source, record))
    with h5py.File(source.path, "r+") as file:
        file["rewards"] = rewards.astype("S")
    with pytest.raises(CorruptDatasetError, match=r"field 'rewards' holds .*, expected 1 numbers per row"):
        list(restored(hdf5, source, record))
    with h5py.File(source.path, "r+") as file:
        del file["rewards"]
        file["rewards"] = rewards + 1
    with pytest.raises(CorruptDatasetError, match=f"incomplete: {REWARD} differs"):
        list(restored(hdf5, source, record))


def test_a_record_with_another_uid_is_told(source: Source, tmp_path: Path) -> None:
    with h5py.File(source.path, "r+") as file:
        record = file["metadata/astra_data"]
        text = record[()].decode() if isinstance(record[()], bytes) else record[()]
        altered = json.loads(text)
        altered["uids"][0] += 1000
        del file["metadata/astra_data"]
        file["metadata/astra_data"] = json.dumps(altered)
    with pytest.raises(CorruptDatasetError, match=r"the record of .* was altered"):
        import_dataset([source.path], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_export_may_be_imported_at_another_rate(source: Source, tmp_path: Path) -> None:
    import_dataset([source.path], out=tmp_path / "out", fps=7)
    assert Dataset.open(tmp_path / "out").info["fps"] == 7


def test_a_record_of_more_rows_than_there_are_is_told(source: Source) -> None:
    record = read_record(hdf5, source)
    assert record is not None
    longer = record.model_copy(update={"lengths": (*record.lengths[:-1], record.lengths[-1] + 1)})
    with pytest.raises(CorruptDatasetError, match="incomplete: the number of rows differs"):
        list(restored(hdf5, source, longer))


def test_at_home_an_export_becomes_the_version_after_those_that_are_there(
    source: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    roots = [import_dataset([source.path]).root.name for _ in range(2)]
    assert roots == ["data-1.0.1", "data-1.0.2"]
