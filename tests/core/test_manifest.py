import hashlib
import json
from pathlib import Path

import pytest

from astra_data.core.artifact import MANIFEST, Manifest, read_manifest, write_manifest
from astra_data.core.errors import BadInputError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "plots").mkdir()
    (tmp_path / "weights").write_bytes(b"abc")
    (tmp_path / "plots/one.png").write_bytes(b"")
    write_manifest(tmp_path, {"dataset": "d1", "grounding": None})
    return tmp_path


def read(folder: Path) -> Manifest:
    manifest = read_manifest(folder)
    assert manifest is not None
    return manifest


def test_a_manifest_holds_sizes_sums_and_what_was_read(folder: Path) -> None:
    assert json.loads((folder / MANIFEST).read_text()) == {
        "files": {
            "plots/one.png": {"bytes": 0, "sha256": hashlib.sha256(b"").hexdigest()},
            "weights": {"bytes": 3, "sha256": hashlib.sha256(b"abc").hexdigest()},
        },
        "made_from": {"dataset": "d1"},
    }
    assert read(folder).faults(folder, verify=True) == read(folder).foreign(folder) == []


def test_damage_is_found(folder: Path) -> None:
    manifest = read(folder)
    (folder / "weights").write_bytes(b"abd")
    assert manifest.faults(folder, verify=False) == []
    assert manifest.faults(folder, verify=True) == ["weights was altered"]
    (folder / "weights").write_bytes(b"")
    (folder / "plots/one.png").unlink()
    faults = ["plots/one.png is missing", "weights has 0 bytes, expected 3"]
    assert manifest.faults(folder, verify=False) == manifest.faults(folder, verify=True) == faults
    (folder / "plots/notes").touch()
    assert manifest.foreign(folder) == ["plots/notes"]


def test_a_folder_without_a_manifest_has_none(tmp_path: Path) -> None:
    assert read_manifest(tmp_path) is None


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"files": {"a": 3}, "made_from": {}}', "\udcff"])
def test_a_manifest_that_cannot_be_read_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / MANIFEST).write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(BadInputError, match=r"^manifest\.json cannot be read"):
        read_manifest(tmp_path)
