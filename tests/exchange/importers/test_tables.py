"""CSV, NPZ, HDF5 and JSON hold the same rows, so they give the same dataset."""

import sys
from pathlib import Path

import numpy as np
import pytest
from recordings import LENGTHS, MAPPING, STEPS, TABLES, imported, rows, write_table

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, DONE, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED
from astra_data.exchange.importers import hdf5, json, npz


@pytest.mark.parametrize("block_rows", [4, 2**13])
@pytest.mark.parametrize("name", TABLES)
def test_every_value_arrives(
    tmp_path: Path, name: str, block_rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (npz, hdf5):
        monkeypatch.setattr(module, "BLOCK_ROWS", block_rows)
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
    assert dataset.description["split_points"] == {"field": 2}
    assert dataset.metadata["source_row"] == [0, 6, 15]
    assert dataset.metadata["source"] == [name] * 3


@pytest.mark.parametrize("name", TABLES)
def test_missing_fields_are_all_told(tmp_path: Path, name: str) -> None:
    fields = rows()
    fields["commando"] = fields.pop("command")
    del fields["gait"]
    path = write_table(tmp_path / name, fields)
    with pytest.raises(
        BadInputError, match=r"no field 'command': did you mean 'commando'\?.*no field 'gait'"
    ):
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
    path = write_table(
        tmp_path / name, fields | {"reward": np.full(20, b"much" if name == "log.h5" else "much")}
    )
    with pytest.raises(BadInputError, match=r"field 'reward'.*expected numbers"):
        imported(tmp_path, path)


@pytest.mark.parametrize("name", TABLES)
def test_no_rows_are_told(tmp_path: Path, name: str) -> None:
    path = write_table(tmp_path / name, {field: values[:0] for field, values in rows().items()})
    with pytest.raises(BadInputError, match="no episodes"):
        imported(tmp_path, path)
    assert not (tmp_path / "out").exists()


def test_text_tells_episodes_apart(tmp_path: Path) -> None:
    fields = rows()
    names = np.array(["first", "2", "last"])[fields["trial"].astype(int)]
    dataset, _ = imported(tmp_path, write_table(tmp_path / "log.csv", fields | {"trial": names}))
    assert dataset.lengths.tolist() == list(STEPS)


def test_csv_whose_later_blocks_look_different(tmp_path: Path) -> None:
    # Two blocks of 1 MB: whole numbers and labels that look like numbers first, then others.
    n = 60_000
    lines = [f"{i},1,0,0,0,1,2,{'0' * 20}\n" for i in range(n)]
    lines += [f"{i}.5,,0.5,0,0,1,b,zzz\n" for i in range(n)]
    path = tmp_path / "log.csv"
    path.write_text("x,y,command,reward,fell,gait,trial,unused\n" + "".join(lines))
    dataset, report = imported(tmp_path, path, 'not_finite = "drop"\n' + MAPPING)
    assert report.tally.rejected_rows == n
    assert report.tally.rejected_first == f"log.csv row {n}"
    assert dataset.lengths.tolist() == [n - 1]


def test_tabs_separate_in_tsv(tmp_path: Path) -> None:
    text = write_table(tmp_path / "log.csv", rows()).read_text()
    (tmp_path / "log.tsv").write_text(text.replace(",", "\t"))
    dataset, _ = imported(tmp_path, tmp_path / "log.tsv")
    assert len(dataset) == 3


def test_a_doubled_field_in_csv_is_told(tmp_path: Path) -> None:
    path = write_table(tmp_path / "log.csv", rows())
    path.write_text(path.read_text().replace("unused", "x", 1))
    with pytest.raises(BadInputError, match="has x more than once"):
        imported(tmp_path, path)


def test_npz_is_never_unpickled(tmp_path: Path) -> None:
    with (tmp_path / "log.npz").open("wb") as file:
        np.savez(file, **rows() | {"reward": np.array([{}] * 20)})  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match=r"reward\.npy: holds Python objects"):
        imported(tmp_path, tmp_path / "log.npz")


def test_npz_in_column_order_is_told(tmp_path: Path) -> None:
    fields = rows() | {"command": np.asfortranarray(np.zeros((20, 2)))}
    with pytest.raises(BadInputError, match="ascontiguousarray"):
        imported(tmp_path, write_table(tmp_path / "log.npz", fields))


def test_json_that_is_too_large_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_table(tmp_path / "log.json", rows())
    monkeypatch.setattr(json, "LIMIT_BYTES", 100)
    with pytest.raises(BadInputError, match="split the file"):
        imported(tmp_path, path)


def test_a_missing_extra_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_table(tmp_path / "log.h5", rows())
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(BadInputError, match=r'h5py .*not installed: .* pip install "astra-data\[hdf5\]"'):
        imported(tmp_path, path)


STAMPED = MAPPING.replace('fields = ["gait"]', 'fields = ["stamp"]')


@pytest.mark.parametrize("name", TABLES)
def test_integers_arrive_exactly(tmp_path: Path, name: str) -> None:
    stamps = 1_700_000_000_050_000_002 + np.arange(20) * 10**8
    dataset, _ = imported(tmp_path, write_table(tmp_path / name, rows() | {"stamp": stamps}), STAMPED)
    expected = np.concatenate([stamps[:5], stamps[6:15], stamps[15:19]])
    np.testing.assert_array_equal(dataset.columns(["gait"])["gait"], expected)


@pytest.mark.parametrize("last", ["", "0.5"])
def test_integers_that_floats_would_alter_are_told(tmp_path: Path, last: str) -> None:
    stamps = np.array(["1700000000050000002"] * 19 + [last])
    path = write_table(tmp_path / "log.csv", rows() | {"stamp": stamps})
    told = r"numbers of 2\^53 or more came as floats" if not last else "expected whole numbers"
    with pytest.raises(BadInputError, match=f"gait: {told}"):
        imported(tmp_path, path, 'not_finite = "drop"\n' + STAMPED)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("spec", ['fields = ["stamp", "x"]', 'fields = ["stamp"]\nscale = [1.0]'])
def test_integers_that_become_floats_on_their_way_are_told(tmp_path: Path, spec: str) -> None:
    fields = rows() | {"stamp": np.full(20, 2**60 + 1), "x": np.zeros(20)}
    with pytest.raises(BadInputError, match=r"gait: numbers of 2\^53 or more came as floats"):
        imported(
            tmp_path, write_table(tmp_path / "log.npz", fields), MAPPING.replace('fields = ["gait"]', spec)
        )


def test_large_integers_need_a_dtype_that_holds_them(tmp_path: Path) -> None:
    fields = rows() | {"stamp": np.full(20, 2**60 + 1)}
    mapping = STAMPED.replace('dtype = "int64"\n', "")
    with pytest.raises(BadInputError, match=r"gait: integers beyond 2\^53 do not fit float32; set dtype"):
        imported(tmp_path, write_table(tmp_path / "log.npz", fields), mapping)
