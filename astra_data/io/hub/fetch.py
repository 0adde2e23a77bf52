"""Resumable download of one file, bounded, and verified by its checksum."""

import os
from pathlib import Path

from astra_data.core.durable import file_digest, writing
from astra_data.core.errors import AstraDataError, SharingError
from astra_data.io.hub.store import RemoteFolder
from astra_data.io.hub.sums import Listed, altered


def fetch(remote: RemoteFolder, path: str, folder: Path, listed: Listed) -> None:
    """Download the file `path` into `folder`, continuing where an earlier call stopped.

    Args:
        remote: where it is.
        path: relative to it and to `folder`; already checked to stay inside them.
        folder: an unfinished download is kept in it as <path>.part; `refuse_planted` has looked at it.
        listed: the file's sha256, and its size, which bounds the download.

    Raises:
        DiskError: it cannot be written.
        SharingError: it cannot be read, is larger, or its checksum is another.
    """
    target = folder / path
    if not altered(folder, {path: listed}):
        return
    part = target.with_name(f"{target.name}.part")
    try:
        with writing(part, place=False):
            part.parent.mkdir(parents=True, exist_ok=True)
            resumed = part.exists()
            _append(remote, path, part, listed.size)
            is_whole = file_digest(part) == listed.digest
            if resumed and not is_whole:
                part.unlink()
                _append(remote, path, part, listed.size)
                is_whole = file_digest(part) == listed.digest
    except AstraDataError:
        raise
    except Exception as error:
        raise SharingError(
            f"{remote.name}: {path} cannot be downloaded ({type(error).__name__}: {error}); "
            "run the same command again to continue."
        ) from error
    if part.stat().st_size > listed.size:
        part.unlink()
        raise SharingError(
            f"{remote.name}: {path} is larger than {listed.size} bytes, as which it was taken."
        )
    if not is_whole:
        part.unlink()
        raise SharingError(
            f"{remote.name}: {path} does not have the sha256 in SHA256SUMS; it was altered there."
        )
    part.replace(target)


def refuse_planted(folder: Path) -> None:
    """Look for what no pull leaves in its unfinished `folder`, through which one would write elsewhere.

    Raises:
        SharingError: there is a link, a device or a pipe, or a file that has another name besides.
    """
    entries = [folder, *folder.rglob("*")] if folder.is_dir() else [folder]
    for entry in entries:
        facts = entry.lstat()
        is_plain = entry.is_file() and facts.st_nlink == 1
        if entry.is_symlink() or not (entry.is_dir() or is_plain):
            raise SharingError(
                f"{entry} is a link, a device or a pipe, which no pull leaves there: "
                f"delete {folder}, then run the same command again."
            )


def _append(remote: RemoteFolder, path: str, part: Path, most: int) -> None:
    """Add what `part` lacks of `path`; one byte over `most` shows that the file is larger."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK
    with open(part, "ab", opener=lambda name, _: os.open(name, flags, 0o666)) as out:
        first = out.tell()
        for block in remote.blocks(path, first=first, most=most + 1 - first):
            out.write(block)
            out.flush()
