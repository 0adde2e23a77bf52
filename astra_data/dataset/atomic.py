"""Folders and files that are written atomically."""

import glob
import itertools
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from astra_data.core.errors import BadInputError
from astra_data.core.lock import held


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """Yield an empty hidden folder beside `target`, which is renamed to `target` when the block ends.

    After an exception the folder is removed. After a kill it stays, hidden, until the next call with the same
    target removes it: the folder of a live process is held by a file lock.

    Raises:
        BadInputError: `target` exists, or another process is writing it.
    """
    _refuse(target)
    _make_parent(target)
    _sweep(target)
    with _own_folder(target) as folder:
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
    _make_parent(target)
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
    try:
        os.replace(folder, target)
    except OSError:
        # Another process may have created it in between.
        _refuse(target)
        raise
    sync(target.parent)


def _refuse(target: Path) -> None:
    if target.exists():
        raise BadInputError(f"{target} exists already; delete it or choose another folder.")


def _make_parent(target: Path) -> None:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError(f"{target} cannot be written: {error.strerror}; choose another place.") from None


@contextmanager
def _own_folder(target: Path) -> Iterator[Path]:
    """Make a hidden folder beside `target` and hold its lock."""
    for attempt in itertools.count():
        folder = target.with_name(f".{target.name}.tmp-{os.getpid()}{f'-{attempt}' if attempt else ''}")
        try:
            folder.mkdir()
        except FileExistsError:
            raise BadInputError(
                f"{target} is being written right now; wait or choose another folder."
            ) from None
        except OSError as error:
            raise BadInputError(
                f"{target} cannot be written: {error.strerror}; choose another place."
            ) from None
        with ExitStack() as stack:
            # Between mkdir and lock another process's sweep may have locked or removed the folder.
            try:
                ours = stack.enter_context(held(folder))
            except FileNotFoundError:
                continue
            if ours and folder.exists():
                yield folder
                return


def _sweep(target: Path) -> None:
    """Remove the hidden folders that killed processes left beside `target`."""
    for folder in target.parent.glob(f".{glob.escape(target.name)}.tmp-*"):
        with suppress(FileNotFoundError, NotADirectoryError), held(folder) as ours:
            if ours:
                shutil.rmtree(folder, ignore_errors=True)


def sync(path: Path) -> None:
    """Flush a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
