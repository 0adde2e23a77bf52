import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from fake_transitions import write_transitions

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import REWARD
from astra_data.exchange.exporters import export
from astra_data.exchange.importers import csv, hdf5
from astra_data.exchange.importing import import_dataset
from astra_data.exchange.recording import Source
from astra_data.exchange.restoring import read_record, restored


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
