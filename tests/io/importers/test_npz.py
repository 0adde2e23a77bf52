from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from recordings import LOG, imported, rows, write_table

from astra_data.core.errors import BadInputError
from astra_data.io.importing import import_dataset


def test_npz_is_never_unpickled(tmp_path: Path) -> None:
    with (tmp_path / "log.npz").open("wb") as file:
        np.savez(file, **rows() | {"reward": np.array([{}] * 20)})  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match=r"\.npz: reward\.npy: Object arrays cannot be loaded"):
        imported(tmp_path, tmp_path / "log.npz")


def test_an_array_that_ends_early_is_told(tmp_path: Path) -> None:
    path = write_table(tmp_path / "log.npz", rows())
    with ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content[:-10] if name == "x.npy" else content)
    with pytest.raises(BadInputError, match=r"x\.npy: EOF: reading array data, expected 160 bytes got 150"):
        imported(tmp_path, path)


def bomb(path: Path, rows: int) -> Path:
    """Write zeros, which are compressed to a thousandth."""
    fields = {name: np.zeros(rows) for name in ("x", "y", "command")}
    np.savez_compressed(path, **fields)  # type: ignore[arg-type]
    return path


BOMB_MAPPING = f"""{LOG}[columns."observation.state"]
fields = ["x", "y"]
[columns.action]
fields = ["command"]
"""


def test_a_file_that_unpacks_to_far_more_than_its_size_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.io.recording.SMALL_BYTES", 10**5)
    path = bomb(tmp_path / "log.npz", 10**5)
    with pytest.raises(BadInputError, match=r"holds values of 2400384 bytes or more, .* --max-bytes"):
        imported(tmp_path, path, BOMB_MAPPING)
    (tmp_path / "mapping.toml").write_text(BOMB_MAPPING)
    report = import_dataset([path], tmp_path / "mapping.toml", out=tmp_path / "out", max_bytes=2_400_384)
    assert report.frames == 10**5 - 1
