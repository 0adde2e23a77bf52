import hashlib
from pathlib import Path
from typing import Any

import fsspec
import pytest

from astra_data.core.errors import SharingError
from astra_data.exchange.sharing import fetch as module
from astra_data.exchange.sharing.fetch import fetch
from astra_data.exchange.sharing.store import RemoteFolder

CONTENT = bytes(range(256)) * 40
DIGEST = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def remote(tmp_path: Path) -> RemoteFolder:
    (tmp_path / "there/data").mkdir(parents=True)
    (tmp_path / "there/data/file").write_bytes(CONTENT)
    return RemoteFolder(fsspec.filesystem("file"), str(tmp_path / "there"), "there")


@pytest.fixture
def appended(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of the part of the file before each time that it is read on."""
    sizes: list[int] = []
    append = module._append

    def watched(remote: Any, path: str, part: Path) -> None:  # noqa: ANN401 - passed on
        sizes.append(part.stat().st_size if part.exists() else 0)
        append(remote, path, part)

    monkeypatch.setattr(module, "_append", watched)
    return sizes


def test_a_file_is_fetched_once(remote: RemoteFolder, tmp_path: Path, appended: list[int]) -> None:
    for _ in range(2):
        fetch(remote, "data/file", tmp_path / "here", DIGEST)
    assert (tmp_path / "here/data/file").read_bytes() == CONTENT
    assert [path.name for path in (tmp_path / "here/data").iterdir()] == ["file"]
    assert appended == [0]


@pytest.mark.parametrize("block", [1000, 2**24])
def test_only_what_is_missing_is_read(
    remote: RemoteFolder, tmp_path: Path, appended: list[int], block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BLOCK_BYTES", block)
    (tmp_path / "here/data").mkdir(parents=True)
    (tmp_path / "here/data/file.part").write_bytes(CONTENT[:5000])
    fetch(remote, "data/file", tmp_path / "here", DIGEST)
    assert (tmp_path / "here/data/file").read_bytes() == CONTENT
    assert appended == [5000]


@pytest.mark.parametrize("left", [b"x" * 5000, b"x" * 10**5])
def test_a_part_of_another_file_is_fetched_from_the_start(
    remote: RemoteFolder, tmp_path: Path, appended: list[int], left: bytes
) -> None:
    (tmp_path / "here/data").mkdir(parents=True)
    (tmp_path / "here/data/file.part").write_bytes(left)
    (tmp_path / "here/data/file").write_bytes(left)
    fetch(remote, "data/file", tmp_path / "here", DIGEST)
    assert (tmp_path / "here/data/file").read_bytes() == CONTENT
    assert appended == [len(left), 0]


def test_another_content_than_listed_is_refused_and_not_kept(remote: RemoteFolder, tmp_path: Path) -> None:
    with pytest.raises(SharingError, match=r"there: data/file does not have the sha256"):
        fetch(remote, "data/file", tmp_path / "here", "0" * 64)
    assert not list((tmp_path / "here/data").iterdir())


def test_a_file_that_is_not_there_is_told(remote: RemoteFolder, tmp_path: Path) -> None:
    with pytest.raises(SharingError, match=r"data/none cannot be downloaded \(FileNotFoundError.*run"):
        fetch(remote, "data/none", tmp_path / "here", DIGEST)
