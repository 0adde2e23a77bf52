"""CSV, NPZ, HDF5, JSON and Parquet hold the same rows, so they give the same dataset."""

from pathlib import Path

import numpy as np
import pytest
from recordings import LENGTHS, STEPS, TABLES, imported, rows, write_table

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, DONE, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED


@pytest.mark.parametrize("name", TABLES)
def test_every_value_arrives(tmp_path: Path, name: str) -> None:
    fields = rows()
    dataset, report = imported(tmp_path, write_table(tmp_path / name, fields))
    assert dataset.lengths.tolist() == list(STEPS)
    kept = np.concatenate([np.arange(n) + first for n, first in zip(STEPS, (0, 6, 15), strict=True)])
    following = np.where(fields["fell"][kept], kept, kept + 1)
    position = np.stack([fields["x"], fields["y"]], axis=1) * 0.001
    got = dataset.columns([STATE, NEXT_STATE, ACTION, REWARD, TERMINATED, TRUNCATED, DONE, "gait"])
    np.testing.assert_array_equal(got[STATE], position[kept].astype(np.float32))
    np.testing.assert_array_equal(got[NEXT_STATE], position[following].astype(np.float32))
    np.testing.assert_array_equal(got[ACTION], np.clip(fields["command"], -1, 1)[kept].astype(np.float32))
    np.testing.assert_array_equal(got[REWARD], fields["reward"][kept].astype(np.float32))
    np.testing.assert_array_equal(got[TERMINATED], fields["fell"][kept])
    np.testing.assert_array_equal(np.flatnonzero(got[DONE]), np.cumsum(dataset.lengths) - 1)
    np.testing.assert_array_equal(got[TRUNCATED], got[DONE] & ~got[TERMINATED])
    np.testing.assert_array_equal(got["gait"], fields["gait"][kept])
    assert dataset.verify() == []
    tally = report.tally
    assert (report.episodes, report.frames, tally.rows) == (3, sum(STEPS), sum(LENGTHS))
    assert (tally.split_points, tally.last_rows, tally.rejected_rows) == ({"field": 2}, 2, 0)
    assert dataset.description["split_points"] == {"field": 2} and dataset.metadata["source_row"] == [0, 6, 15]
    assert dataset.metadata["source"] == [name] * 3


@pytest.mark.parametrize("name", TABLES)
def test_missing_fields_are_all_told(tmp_path: Path, name: str) -> None:
    fields = rows()
    fields["commando"] = fields.pop("command")
    del fields["gait"]
    path = write_table(tmp_path / name, fields)
    with pytest.raises(BadInputError, match=r"no field 'command': did you mean 'commando'\?.*no field 'gait'"):
        imported(tmp_path, path)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["log.npz", "log.h5", "log.json"])
def test_ragged_fields_are_told(tmp_path: Path, name: str) -> None:
    path = write_table(tmp_path / name, rows() | {"reward": np.zeros(3)})
    with pytest.raises(BadInputError, match=r"differ in their number of rows \(x 20, .*reward 3"):
        imported(tmp_path, path)


@pytest.mark.parametrize("name", TABLES)
def test_text_for_numbers_is_told(tmp_path: Path, name: str) -> None:
    fields = rows()
    path = write_table(tmp_path / name, fields | {"reward": np.full(20, b"much" if name == "log.h5" else "much")})
    with pytest.raises(BadInputError, match=r"field 'reward'.*expected numbers"):
        imported(tmp_path, path)


@pytest.mark.parametrize("name", ["log.csv", "log.json"])
def test_a_field_that_comes_twice_is_told(tmp_path: Path, name: str) -> None:
    path = write_table(tmp_path / name, rows())
    path.write_text(path.read_text().replace("unused", "x", 1))
    with pytest.raises(BadInputError, match="has x more than once"):
        imported(tmp_path, path)
