import json
from pathlib import Path

import fsspec
import pytest

from astra_data.core.errors import SharingError
from astra_data.io.hub.store import RemoteFolder


@pytest.fixture
def folder(tmp_path: Path) -> RemoteFolder:
    (tmp_path / "meta/astra").mkdir(parents=True)
    return RemoteFolder(fsspec.filesystem("file"), str(tmp_path), "it@data-1.0.0")


def test_texts_and_the_description_are_read(folder: RemoteFolder, tmp_path: Path) -> None:
    (tmp_path / "note").write_text("Größe", encoding="utf-8")
    (tmp_path / "meta/astra/dataset.json").write_text(json.dumps({"name": "it"}))
    assert folder.read_text("note") == "Größe"
    assert folder.description() == {"name": "it"}


def test_what_is_not_there_was_not_pushed_by_us(folder: RemoteFolder) -> None:
    with pytest.raises(SharingError, match=r"^it@data-1\.0\.0 has no meta/astra/dataset\.json: it was"):
        folder.description()


@pytest.mark.parametrize("content", [b"[1]", b"{", b"3"])
def test_a_description_that_is_no_object_is_told(
    folder: RemoteFolder, tmp_path: Path, content: bytes
) -> None:
    (tmp_path / "meta/astra/dataset.json").write_bytes(content)
    with pytest.raises(SharingError, match=r"dataset\.json is not a JSON object"):
        folder.description()


def test_what_is_no_text_is_told(folder: RemoteFolder, tmp_path: Path) -> None:
    (tmp_path / "note").write_bytes(b"\xff")
    with pytest.raises(SharingError, match=r"note cannot be read \(UnicodeDecodeError"):
        folder.read_text("note")
