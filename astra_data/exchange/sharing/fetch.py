"""Resumable download of one file, verified by its checksum."""

from pathlib import Path

from astra_data.core.digest import file_digest
from astra_data.core.errors import SharingError
from astra_data.exchange.sharing.store import RemoteFolder

BLOCK_BYTES = 2**24
"""Bytes per request."""


def fetch(remote: RemoteFolder, path: str, folder: Path, digest: str) -> None:
    """Download the file `path` into `folder`, continuing where an earlier call stopped.

    Args:
        remote: where it is.
        path: relative to it and to `folder`; already checked to stay inside them.
        folder: an unfinished download is kept in it as <path>.part.
        digest: the file's sha256.

    Raises:
        SharingError: it cannot be read or written, or its checksum is another.
    """
    target = folder / path
    if target.is_file() and file_digest(target) == digest:
        return
    part = target.with_name(f"{target.name}.part")
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        resumed = part.exists()
        _append(remote, path, part)
        if resumed and file_digest(part) != digest:
            part.unlink()
            _append(remote, path, part)
    except Exception as error:
        raise SharingError(
            f"{remote.name}: {path} cannot be downloaded ({type(error).__name__}: {error}); "
            "run the same command again to continue."
        ) from error
    if file_digest(part) != digest:
        part.unlink()
        raise SharingError(
            f"{remote.name}: {path} does not have the sha256 in SHA256SUMS; it was altered there."
        )
    part.replace(target)


def _append(remote: RemoteFolder, path: str, part: Path) -> None:
    options = {"block_size": BLOCK_BYTES, "cache_type": "none"}
    with remote.filesystem.open(f"{remote.path}/{path}", "rb", **options) as source, part.open("ab") as out:
        if out.tell():
            source.seek(min(out.tell(), source.size))
        while block := source.read(BLOCK_BYTES):
            out.write(block)
            out.flush()
