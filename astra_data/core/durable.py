"""Files and folders that are whole or absent, also after a kill or a power failure.

While one is written, it is in a hidden folder beside its place, `.<name>.tmp-<process>`, which the process
holds by a lock. What killed processes left is removed by the next one with the same target, or by `clean`.
"""

import fnmatch
import glob
import itertools
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from astra_data.core.disk import writing
from astra_data.core.errors import BadInputError
from astra_data.core.lock import held

NO_FSYNC = "ASTRA_DATA_NO_FSYNC"
"""Environment variable; unless it is empty, files survive a kill but perhaps not a power failure."""

_HIDDEN = re.compile(r"\..+\.tmp-\d+(-\d+)?")
"""Names of what is being written."""
_RESUMABLE = re.compile(r"\..+\.(staged|partial|pull-\d+\.\d+\.\d+)")
"""Names of folders with which a command goes on."""


def sync(path: Path) -> None:
    """Flush a file or folder to the disk, unless `NO_FSYNC` is set."""
    if os.environ.get(NO_FSYNC):
        return
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Flush `folder` and everything in it to the disk."""
    for path in (*folder.rglob("*"), folder):
        if path.is_file() or path.is_dir():
            sync(path)


def move(source: Path, target: Path) -> None:
    """Rename `source` to `target`, replacing a file; when this returns, the disk knows."""
    os.replace(source, target)
    sync(target.parent)


def make_folder(folder: Path) -> list[Path]:
    """Make `folder` and those that it is in; return those that were not there, the innermost first.

    When this returns, the disk knows.
    """
    missing = _missing(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        sync(path.parent)
    return missing


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove those of `folders`, the innermost first, that hold nothing."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def write_file(path: Path, content: str | bytes) -> None:
    """Write `path` atomically, replacing an older file; text becomes UTF-8.

    Raises:
        DiskError: it cannot be written; the older file stays.
    """
    data = content.encode() if isinstance(content, str) else content
    if path.exists() and not path.is_file():  # such as /dev/stdout, which must not be replaced
        with writing(path):
            path.write_bytes(data)
        return
    with hidden_folder(path) as folder:
        partial = folder / path.name
        partial.write_bytes(data)
        sync(partial)
        move(partial, path)


@contextmanager
def hidden_folder(target: Path) -> Iterator[Path]:
    """Yield an empty hidden folder beside `target`, which is removed when the block ends.

    After a kill it stays until the next call with the same target: the folder of a live process is locked.
    If the block fails, folders made for `target` go, too.

    Raises:
        BadInputError: this process is writing `target` already.
        DiskError: it cannot be written.
    """
    with writing(target), folder_for(target):
        sweep(target)
        with _own_folder(target) as folder:
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)


def discard(folder: Path, target: Path) -> None:
    """Remove `folder`, if it is there, which belongs to `target`.

    It is renamed first, so that it cannot be half removed.
    """
    dead = next(name for name in _hidden_names(target) if not name.exists())
    with suppress(FileNotFoundError):
        move(folder, dead)
    shutil.rmtree(dead, ignore_errors=True)


def sweep(target: Path) -> None:
    """Remove what killed processes left beside `target`."""
    for path in target.parent.glob(f".{glob.escape(target.name)}.tmp-*"):
        _remove_dead(path)


def clean(folder: Path) -> list[tuple[Path, str]]:
    """Remove what killed processes left anywhere below `folder`; return each path and what became of it.

    That is "removed"; "in use", where a live process writes it; or "kept", where the command that was killed
    goes on with it.
    """
    found = []
    for parent, folders, files in os.walk(folder):
        for name in sorted((*folders, *files)):
            path = Path(parent, name)
            if _HIDDEN.fullmatch(name):
                found.append((path, "removed" if _remove_dead(path) else "in use"))
            elif name in folders and _RESUMABLE.fullmatch(name):
                found.append((path, "kept"))
        folders[:] = [name for name in folders if not _HIDDEN.fullmatch(name)]
    return found


def begun_beside(target: Path) -> list[Path]:
    """Return the folders beside `target` with which a command goes on to make it."""
    beside = target.parent.glob(f".{glob.escape(target.name)}.*")
    return sorted(path for path in beside if _RESUMABLE.fullmatch(path.name))


def made_in(folder: Path, finished: str) -> list[Path]:
    """Return what commands go on with in `folder`, if that is all it holds; else the folder itself.

    An empty folder holds nothing; one whose name matches `finished`, such as "seed_*", is not empty.
    """
    unfinished: list[Path] = []
    for parent, folders, files in os.walk(folder):
        inner = [name for name in folders if not _HIDDEN.fullmatch(name)]
        unfinished += [Path(parent, name) for name in inner if _RESUMABLE.fullmatch(name)]
        folders[:] = [name for name in inner if not _RESUMABLE.fullmatch(name)]
        if fnmatch.filter(folders, finished) or not all(map(_HIDDEN.fullmatch, files)):
            return [folder]
    return sorted(unfinished)


def _remove_dead(path: Path) -> bool:
    """Remove a hidden file or folder unless a live process holds it; return whether it is gone."""
    with suppress(OSError), held(path) as ours:
        if not ours:
            return False
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()
    return not path.exists()


@contextmanager
def folder_for(target: Path) -> Iterator[None]:
    """Make the folder that `target` is in; if the block fails, remove what was made and holds nothing."""
    missing = _missing(target.parent)
    try:
        make_folder(target.parent)
        yield
    except BaseException:
        remove_empty(missing)
        raise


def _missing(folder: Path) -> list[Path]:
    return [path for path in (folder, *folder.parents) if not path.exists()]


def _hidden_names(target: Path) -> Iterator[Path]:
    for attempt in itertools.count():
        yield target.parent / f".{target.name}.tmp-{os.getpid()}{f'-{attempt}' if attempt else ''}"


@contextmanager
def _own_folder(target: Path) -> Iterator[Path]:
    """Make a hidden folder beside `target` and hold its lock."""
    for folder in _hidden_names(target):
        try:
            folder.mkdir(parents=True)  # another process may have removed a folder that it had made
        except FileExistsError:
            raise BadInputError(
                f"{target} is being written right now; wait or choose another folder."
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
