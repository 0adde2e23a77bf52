from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from recordings import imported, rows, write_table

from astra_data.core.errors import BadInputError
from astra_data.exchange.importers import npz
from astra_data.exchange.mapping import ImportMapping
from astra_data.exchange.recording import Source


def test_npz_is_never_unpickled(tmp_path: Path) -> None:
    with (tmp_path / "log.npz").open("wb") as file:
        np.savez(file, **rows() | {"reward": np.array([{}] * 20)})  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match=r"reward\.npy: holds Python objects"):
        imported(tmp_path, tmp_path / "log.npz")


def test_npz_in_column_order_is_told(tmp_path: Path) -> None:
    fields = rows() | {"command": np.asfortranarray(np.zeros((20, 2)))}
    with pytest.raises(BadInputError, match="ascontiguousarray"):
        imported(tmp_path, write_table(tmp_path / "log.npz", fields))


def test_an_array_that_ends_early_is_told(tmp_path: Path) -> None:
    path = write_table(tmp_path / "log.npz", rows())
    with ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content[:-10] if name == "x.npy" else content)
    with pytest.raises(BadInputError, match=r"x\.npy: ends early, 10 bytes are missing"):
        imported(tmp_path, path)


def test_blocks_hold_consecutive_rows_of_every_array(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz, "BLOCK_ROWS", 7)
    fields = {"a": np.arange(20), "b": np.arange(40.0).reshape(20, 2)}
    path = write_table(tmp_path / "log.npz", fields)
    columns = {name: {"fields": (name,)} for name in fields}
    mapping = ImportMapping.model_validate({"name": "n", "task": "t", "fps": 1, "columns": columns})
    blocks = list(npz.read(Source(path, None, path), mapping))
    assert [len(block) for block in blocks] == [7, 7, 6]
    for name, values in fields.items():
        read = np.concatenate([block.values[name] for block in blocks])
        np.testing.assert_array_equal(read, values)
        assert read.dtype == values.dtype
