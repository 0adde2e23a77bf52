"""Folders and files that are written atomically, and never over others."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from astra_data.core.durable import hidden_folder, move, sync, sync_tree, writing
from astra_data.core.errors import BadInputError


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """Yield an empty hidden folder beside `target`, which is renamed to `target` when the block ends.

    After an exception the folder is removed; after a kill it stays until the next call with the same target.

    Raises:
        BadInputError: `target` exists, or this process is writing it already.
        DiskError: it cannot be written.
    """
    refuse_existing(target)
    with hidden_folder(target) as folder:
        yield folder
        publish(folder, target)


@contextmanager
def atomic_file(target: Path) -> Iterator[Path]:
    """Yield the path of a file in a hidden folder, which is renamed to `target` when the block ends.

    After an exception it is removed; after a kill it stays until the next call with the same target.

    Raises:
        BadInputError: `target` exists, or this process is writing it already.
        DiskError: it cannot be written.
    """
    refuse_existing(target)
    with hidden_folder(target) as folder:
        path = folder / target.name
        yield path
        sync(path)
        refuse_existing(target)
        move(path, target)


def publish(folder: Path, target: Path) -> None:
    """Rename the finished `folder` to `target` beside it, once all of it is on the disk.

    Raises:
        BadInputError: `target` exists.
        DiskError: it cannot be written.
    """
    with writing(target):
        sync_tree(folder)
        refuse_existing(target)
        try:
            os.replace(folder, target)
        except OSError:
            # Another process may have created it in between.
            refuse_existing(target)
            raise
        sync(target.parent)


def refuse_existing(target: Path) -> None:
    """Refuse to write where something is.

    Raises:
        BadInputError: `target` exists, or is a link to nothing.
    """
    if target.exists() or target.is_symlink():
        raise BadInputError(f"{target} exists already; delete it or choose another folder.")
