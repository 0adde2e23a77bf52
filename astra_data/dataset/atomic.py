"""Folders and files that appear finished or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from astra_data.errors import BadInputError
from astra_data.lock import held


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """Yield an empty hidden folder beside `target`, which is renamed to `target` when the block ends.

    After an exception the folder is removed. After a kill it stays, hidden, and the next call with the same
    target removes it: a folder is held by a file lock, which dies with its process.

    Raises:
        BadInputError: `target` exists, or another process is writing it.
    """
    _refuse(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    _sweep(target)
    folder = target.with_name(f".{target.name}.tmp-{os.getpid()}")
    try:
        folder.mkdir()
    except FileExistsError:
        raise BadInputError(f"{target} is being written right now; wait or choose another folder.") from None
    with held(folder):
        try:
            yield folder
            publish(folder, target)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def atomic_file(target: Path) -> Iterator[Path]:
    """Yield the path of a hidden file beside `target`, which is renamed to `target` when the block ends.

    After an exception it is removed; after a kill it stays, hidden.

    Raises:
        BadInputError: `target` exists.
    """
    _refuse(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    path = target.with_name(f".{target.name}.tmp-{os.getpid()}")
    try:
        yield path
        sync(path)
        _refuse(target)
        os.replace(path, target)
        sync(target.parent)
    finally:
        path.unlink(missing_ok=True)


def publish(folder: Path, target: Path) -> None:
    """Rename the finished `folder` to `target` beside it, once all of it is on the disk.

    Raises:
        BadInputError: `target` exists.
    """
    for path in folder.rglob("*"):
        sync(path)
    _refuse(target)
    os.replace(folder, target)
    sync(target.parent)


def _refuse(target: Path) -> None:
    if target.exists():
        raise BadInputError(f"{target} exists already; delete it or choose another folder.")


def _sweep(target: Path) -> None:
    for folder in target.parent.iterdir():
        if folder.name.startswith(f".{target.name}.tmp-") and folder.is_dir():
            with held(folder) as ours:
                if ours:
                    shutil.rmtree(folder, ignore_errors=True)


def sync(path: Path) -> None:
    """Have a file or folder on the disk itself before going on."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
