"""What to report when a disk is full, read-only, failing or gone."""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from astra_data.core.errors import AstraDataError, DiskError

_OF_THE_DISK = {
    errno.ENOSPC: ("the disk is full", "free space"),
    errno.EDQUOT: ("the quota is exceeded", "free space"),
    errno.EFBIG: ("a file would be larger than is allowed", "raise the limit (ulimit -f)"),
    errno.EROFS: ("the disk is read-only", "make it writable or choose another folder"),
    errno.EIO: ("the disk reports an error", "check it"),
    errno.ENODEV: ("the disk is gone", "connect it again"),
    errno.ENXIO: ("the disk is gone", "connect it again"),
    errno.ESTALE: ("the disk is gone", "connect it again"),
}
"""Faults that are the disk's whatever was written: why, and what to do."""
_OF_THE_PLACE = {
    errno.EACCES: ("permission is denied", "change the permissions or choose another folder"),
    errno.EPERM: ("permission is denied", "change the permissions or choose another folder"),
    errno.ENOENT: ("its folder is gone", "check that its disk is there"),
    errno.ENOTDIR: ("a file is where its folder would be", "choose another folder"),
    errno.EEXIST: ("a file is where its folder would be", "choose another folder"),
    errno.EISDIR: ("a folder has its name", "choose another name"),
    errno.ENAMETOOLONG: ("its name is too long", "choose a shorter one"),
}


@contextmanager
def writing(target: Path, *, place: bool = True) -> Iterator[None]:
    """Report that `target` cannot be written, if the block fails because of the disk or of its place.

    Args:
        target: what is written.
        place: also report what is wrong with its place, such as permissions, not the disk's faults alone.

    Raises:
        DiskError: says why, and what to do.
    """
    try:
        yield
    except Exception as error:
        code = _code(error)
        if code not in _OF_THE_DISK and not (place and code and _is_about(error, target)):
            raise
        raise DiskError(_report(f"{target} cannot be written", code)) from error


def disk_error(error: Exception) -> DiskError | None:
    """Return what to report of an error that nobody expected; None if it does not come from a disk."""
    code = _code(error)
    name = getattr(error, "filename", None)
    if code is None or not (name or code in _OF_THE_DISK):
        return None
    subject = os.fsdecode(name) if isinstance(name, str | bytes) else "a file"
    return DiskError(_report(f"{subject} cannot be read or written", code))


def _report(fault: str, code: int) -> str:
    known = _OF_THE_DISK | _OF_THE_PLACE
    why, advice = known.get(code, (os.strerror(code).lower(), "choose another place"))
    return f"{fault}: {why}. What was finished before is safe: {advice}, then run the same command again."


def _code(error: Exception) -> int | None:
    """Return the system's number of a fault; HDF5 has it in the text of errors of any type.

    None where there is no number, or the error is one of ours, which says all there is to say.
    """
    if isinstance(error, AstraDataError):
        return None
    if isinstance(error, OSError) and error.errno:
        return error.errno
    found = re.search(r"\berrno = (\d+)", str(error))
    return int(found[1]) if found else None


def _is_about(error: Exception, target: Path) -> bool:
    """Return whether `error` names `target`, a folder that it is in, or a hidden file or folder of it."""
    name = getattr(error, "filename", None)
    if not isinstance(name, str | bytes):
        return False
    path = Path(os.fsdecode(name))
    hidden = str(target.parent / f".{target.name}.")
    return path in (target, *target.parents) or target in path.parents or str(path).startswith(hidden)
