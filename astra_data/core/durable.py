"""Files and folders that are whole or absent, also after a kill or a power failure.

While one is written, it is in a locked hidden folder beside its place; what killed processes left is swept later.
"""

import errno
import fcntl
import glob
import hashlib
import itertools
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from astra_data.core.errors import AstraDataError, BadInputError, DiskError

NO_FSYNC = "ASTRA_DATA_NO_FSYNC"
"""Environment variable; unless it is empty, files survive a kill but perhaps not a power failure."""

_HIDDEN = re.compile(r"\..+\.tmp-\d+(-\d+)?")  # names of what is being written
_RESUMABLE = re.compile(r"\..+\.(staged|partial|pull-\d+\.\d+\.\d+)")  # names of folders with which a command goes on

_OF_THE_DISK = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), ("the disk is full", "free space")),
    errno.EFBIG: ("a file would be larger than is allowed", "raise the limit (ulimit -f)"),
    errno.EROFS: ("the disk is read-only", "make it writable or choose another folder"),
    **dict.fromkeys(
        (errno.EIO, errno.ENODEV, errno.ENXIO, errno.ESTALE), ("the disk failed", "check that it is there")
    ),
}  # faults that are the disk's whatever was written: why, and what to do


@contextmanager
def writing(target: Path, *, place: bool = True) -> Iterator[None]:
    """Raise a DiskError if the block fails because of the disk or, with `place`, of where `target` is."""
    try:
        yield
    except Exception as error:
        code = _code(error)
        if code not in _OF_THE_DISK and not (place and code and _is_about(error, target)):
            raise
        raise DiskError(_report(f"{target} cannot be written", code)) from error


def disk_error(error: Exception) -> DiskError | None:
    """Return what to report of an error that nobody expected; None if it does not come from a disk."""
    code, name = _code(error), getattr(error, "filename", None)
    if code is None or not (name or code in _OF_THE_DISK):
        return None
    subject = os.fsdecode(name) if isinstance(name, str | bytes) else "a file"
    return DiskError(_report(f"{subject} cannot be read or written", code))


def _report(fault: str, code: int) -> str:
    in_the_way = "a file is where a folder has to be" if code in (errno.EEXIST, errno.ENOTDIR) else None
    why, advice = _OF_THE_DISK.get(code, (in_the_way or os.strerror(code).lower(), "choose another place"))
    return f"{fault}: {why}. What was finished before is safe: {advice}, then run the same command again."


def _code(error: Exception) -> int | None:
    """Return the system's number of a fault, which HDF5 has in its text; None for errors of ours."""
    if isinstance(error, OSError) and error.errno:
        return error.errno
    found = None if isinstance(error, AstraDataError) else re.search(r"\berrno = (\d+)", str(error))
    return int(found[1]) if found else None


def _is_about(error: Exception, target: Path) -> bool:
    """Return whether `error` names `target`, a folder that it is in, or a hidden file or folder of it."""
    if not isinstance(name := getattr(error, "filename", None), str | bytes):
        return False
    path, hidden = Path(os.fsdecode(name)), str(target.parent / f".{target.name}.")
    return path in (target, *target.parents) or target in path.parents or str(path).startswith(hidden)


@contextmanager
def held(folder: Path, *, wait: bool = False) -> Iterator[bool]:
    """Hold the lock of `folder`, with `wait` once no other process holds it; yield whether it is held."""
    handle = os.open(folder, os.O_RDONLY | os.O_NONBLOCK)  # a pipe would wait for a writer
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        yield False
    else:
        yield True
    finally:
        os.close(handle)


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Hold the lock of a run's folder; raise a BadInputError if another process holds it."""
    with held(folder) as ours:
        if not ours:
            raise BadInputError(f"{folder} is in use by another run: wait until it ends, or stop it")
        yield


def sync(path: Path) -> None:
    """Flush a file or folder to the disk, unless `NO_FSYNC` is set."""
    if os.environ.get(NO_FSYNC):
        return
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(root: Path) -> None:
    """Flush a file, or a folder and everything in it, to the disk."""
    for path in (*root.rglob("*"), root):
        if path.is_file() or path.is_dir():
            sync(path)


def move(source: Path, target: Path) -> None:
    """Rename `source` to `target`, on the disk, replacing a file."""
    os.replace(source, target)
    sync(target.parent)


def make_folder(folder: Path) -> list[Path]:
    """Make `folder` and those that it is in, on the disk; return those made, the innermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        sync(path.parent)
    return missing


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove those of `folders`, the innermost first, that hold nothing."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


@contextmanager
def folder_for(target: Path) -> Iterator[None]:
    """Make the folder that `target` is in; if the block fails, remove what was made and holds nothing."""
    missing = [path for path in target.parents if not path.exists()]
    try:
        make_folder(target.parent)
        yield
    except BaseException:
        remove_empty(missing)
        raise


def write_file(path: Path, content: str | bytes) -> None:
    """Write `path`, or what it links to, atomically: an older file stays after a DiskError; text becomes UTF-8."""
    data = content.encode() if isinstance(content, str) else content
    if path.exists() and not path.is_file():  # such as /dev/stdout, which must not be replaced
        with writing(path):
            path.write_bytes(data)
        return
    path = Path(os.path.realpath(path)) if path.is_symlink() else path
    with hidden_folder(path) as folder:
        partial = folder / path.name
        partial.write_bytes(data)
        sync(partial)
        move(partial, path)


@contextmanager
def hidden_folder(target: Path) -> Iterator[Path]:
    """Yield an empty hidden folder beside `target`, locked, and removed with those made for it when the block ends."""
    with writing(target), folder_for(target), ExitStack() as stack:
        sweep(target)
        for folder in _hidden_names(target):
            try:
                folder.mkdir(parents=True)  # another process may have removed a folder that it had made
            except FileExistsError:
                message = f"{target} is being written right now; wait or choose another folder."
                raise BadInputError(message) from None
            # Between mkdir and lock another process's sweep may have locked or removed the folder.
            with suppress(FileNotFoundError):
                if stack.enter_context(held(folder)) and folder.exists():
                    break
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """Yield an empty hidden folder beside `target`, renamed to it at the end; refuse one that exists."""
    refuse_existing(target)
    with hidden_folder(target) as folder:
        yield folder
        publish(folder, target)


def publish(finished: Path, target: Path) -> None:
    """Rename a finished file or folder to `target` beside it, unless that exists, once it is on the disk."""
    with writing(target):
        sync_tree(finished)
        refuse_existing(target)
        try:
            move(finished, target)
        except OSError:
            refuse_existing(target)  # another process may have created it in between
            raise


def refuse_existing(target: Path) -> None:
    """Raise a BadInputError if `target` exists, or is a link to nothing."""
    if target.exists() or target.is_symlink():
        raise BadInputError(f"{target} exists already; delete it or choose another folder.")


def discard(folder: Path, target: Path) -> None:
    """Remove the `folder` of `target`, if it is there; it is renamed first, so it is never half removed."""
    dead = next(name for name in _hidden_names(target) if not name.exists())
    with suppress(FileNotFoundError):
        move(folder, dead)
    shutil.rmtree(dead, ignore_errors=True)


def sweep(target: Path) -> None:
    """Remove what killed processes left beside `target`."""
    for path in target.parent.glob(f".{glob.escape(target.name)}.tmp-*"):
        _remove_dead(path)


def clean(folder: Path) -> None:
    """Remove what killed processes left below `folder`, but for what a command goes on with."""
    for parent, folders, files in os.walk(folder):
        for name in filter(_HIDDEN.fullmatch, (*folders, *files)):
            _remove_dead(Path(parent, name))
        folders[:] = [name for name in folders if not _HIDDEN.fullmatch(name)]


def begun_beside(target: Path) -> list[Path]:
    """Return the folders beside `target` with which a command goes on to make it."""
    beside = target.parent.glob(f".{glob.escape(target.name)}.*")
    return sorted(path for path in beside if _RESUMABLE.fullmatch(path.name))


def _remove_dead(path: Path) -> None:
    """Remove a hidden file or folder unless a live process holds it."""
    with suppress(OSError), held(path) as ours:
        if ours and path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        elif ours:
            path.unlink()


def _hidden_names(target: Path) -> Iterator[Path]:
    for attempt in itertools.count():
        yield target.parent / f".{target.name}.tmp-{os.getpid()}{f'-{attempt}' if attempt else ''}"


def file_digest(path: Path) -> str:
    """Return the sha256 of the file at `path` in hex; it is read in pieces."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_below(folder: Path) -> list[Path]:
    """Return the files in `folder` and below, sorted, and those in folders elsewhere that links lead to, each once."""
    root, seen, found, todo = folder.resolve(), set[Path](), list[Path](), [folder]
    while todo:
        links: list[Path] = []
        for here, folders, names in todo.pop(0).walk():
            if here.resolve() in seen:
                folders.clear()
                continue
            seen.add(here.resolve())
            paths = [here / name for name in names]
            links += [path for path in paths if path.is_dir()]
            found += [path for path in paths if path.is_file()]
        links = [link for link in links if not root.is_relative_to(link.resolve())]
        todo += sorted(links, key=lambda link: (link.name.startswith("."), link))
    return sorted(found)
