"""Folders and files that appear finished or not at all."""

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

    After an exception the folder is removed. After a kill it stays, hidden, and the next call with the same
    target removes it: a folder is held by a file lock, which dies with its process.

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
        # Another process may have been faster by a hair.
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
            # A process that sweeps may have come between: it holds the new folder, or has removed it.
            try:
                ours = stack.enter_context(held(folder))
            except FileNotFoundError:
                continue
            if ours and folder.exists():
                yield folder
                return


def _sweep(target: Path) -> None:
    """Remove what killed processes left of earlier attempts at `target`."""
    for folder in target.parent.glob(f".{glob.escape(target.name)}.tmp-*"):
        with suppress(FileNotFoundError, NotADirectoryError), held(folder) as ours:
            if ours:
                shutil.rmtree(folder, ignore_errors=True)


def sync(path: Path) -> None:
    """Have a file or folder on the disk itself before going on."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
