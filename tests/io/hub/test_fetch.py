import errno
import hashlib
import os
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import fsspec
import pytest

from astra_data.core.durable import file_digest
from astra_data.core.errors import DiskError, SharingError
from astra_data.io.hub import fetch as module
from astra_data.io.hub import store
from astra_data.io.hub.fetch import fetch, refuse_planted
from astra_data.io.hub.store import RemoteFolder
from astra_data.io.hub.sums import Listed

CONTENT = bytes(range(256)) * 40
LISTED = Listed(hashlib.sha256(CONTENT).hexdigest(), len(CONTENT))


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

    def watched(remote: Any, path: str, part: Path, most: int) -> None:  # noqa: ANN401 - passed on
        sizes.append(part.stat().st_size if part.exists() else 0)
        append(remote, path, part, most)

    monkeypatch.setattr(module, "_append", watched)
    return sizes


def test_a_file_is_fetched_once(remote: RemoteFolder, tmp_path: Path, appended: list[int]) -> None:
    for _ in range(2):
        fetch(remote, "data/file", tmp_path / "here", LISTED)
    assert (tmp_path / "here/data/file").read_bytes() == CONTENT
    assert [path.name for path in (tmp_path / "here/data").iterdir()] == ["file"]
    assert appended == [0]


@pytest.mark.parametrize("block", [1000, 2**24])
def test_only_what_is_missing_is_read(
    remote: RemoteFolder, tmp_path: Path, appended: list[int], block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "BLOCK_BYTES", block)
    (tmp_path / "here/data").mkdir(parents=True)
    (tmp_path / "here/data/file.part").write_bytes(CONTENT[:5000])
    digested = Mock(wraps=file_digest)
    monkeypatch.setattr(module, "file_digest", digested)
    fetch(remote, "data/file", tmp_path / "here", LISTED)
    assert (tmp_path / "here/data/file").read_bytes() == CONTENT
    assert appended == [5000]
    digested.assert_called_once()


@pytest.mark.parametrize("left", [b"x" * 5000, b"x" * 10**5])
def test_a_part_of_another_file_is_fetched_from_the_start(
    remote: RemoteFolder, tmp_path: Path, appended: list[int], left: bytes
) -> None:
    (tmp_path / "here/data").mkdir(parents=True)
    (tmp_path / "here/data/file.part").write_bytes(left)
    (tmp_path / "here/data/file").write_bytes(left)
    fetch(remote, "data/file", tmp_path / "here", LISTED)
    assert (tmp_path / "here/data/file").read_bytes() == CONTENT
    assert appended == [len(left), 0]


def test_another_content_than_listed_is_refused_and_not_kept(remote: RemoteFolder, tmp_path: Path) -> None:
    with pytest.raises(SharingError, match=r"there: data/file does not have the sha256"):
        fetch(remote, "data/file", tmp_path / "here", Listed("0" * 64, len(CONTENT)))
    assert not list((tmp_path / "here/data").iterdir())


def test_a_file_that_is_not_there_is_told(remote: RemoteFolder, tmp_path: Path) -> None:
    with pytest.raises(SharingError, match=r"data/none cannot be downloaded \(FileNotFoundError.*run"):
        fetch(remote, "data/none", tmp_path / "here", LISTED)


def test_no_more_is_fetched_than_is_listed(
    remote: RemoteFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[int] = []
    blocks = RemoteFolder.blocks

    def watched(self: RemoteFolder, path: str, **options: int) -> Any:  # noqa: ANN401 - passed on
        for block in blocks(self, path, **options):
            written.append(len(block))
            yield block

    monkeypatch.setattr(RemoteFolder, "blocks", watched)
    with pytest.raises(SharingError, match="data/file is larger than 5000 bytes"):
        fetch(remote, "data/file", tmp_path / "here", Listed(LISTED.digest, 5000))
    assert sum(written) == 5001
    assert not list((tmp_path / "here/data").iterdir())


def test_a_link_in_the_unfinished_folder_is_not_written_through(remote: RemoteFolder, tmp_path: Path) -> None:
    (tmp_path / "here/data").mkdir(parents=True)
    (tmp_path / "prey").write_text("prey")
    (tmp_path / "here/data/file.part").symlink_to(tmp_path / "prey")
    with pytest.raises(SharingError, match="cannot be downloaded"):
        fetch(remote, "data/file", tmp_path / "here", LISTED)
    assert (tmp_path / "prey").read_text() == "prey"


def test_a_full_disk_is_told_and_what_was_fetched_stays(
    remote: RemoteFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    with monkeypatch.context() as patched:
        patched.setattr(module, "_append", full)
        with pytest.raises(DiskError, match=r"here/data/file\.part cannot be written: the disk is full"):
            fetch(remote, "data/file", tmp_path / "here", LISTED)
    fetch(remote, "data/file", tmp_path / "here", LISTED)
    assert (tmp_path / "here/data/file").read_bytes() == CONTENT


def plant_link(folder: Path) -> None:
    (folder / "data/chunk-000").symlink_to(folder.parent / "elsewhere")


def plant_hard_link(folder: Path) -> None:
    (folder / "data/file.part").hardlink_to(folder.parent / "elsewhere/prey")


@pytest.mark.parametrize(
    "plant", [plant_link, plant_hard_link, lambda folder: os.mkfifo(folder / "data/file.part")]
)
def test_what_was_planted_in_an_unfinished_folder_is_refused(tmp_path: Path, plant: Any) -> None:  # noqa: ANN401
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/prey").touch()
    (tmp_path / "here/data").mkdir(parents=True)
    (tmp_path / "here/data/other.part").touch()
    refuse_planted(tmp_path / "here")
    plant(tmp_path / "here")
    with pytest.raises(SharingError, match="which no pull leaves there: delete"):
        refuse_planted(tmp_path / "here")


def test_an_unfinished_folder_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "here").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(SharingError, match="is a link"):
        refuse_planted(tmp_path / "here")
