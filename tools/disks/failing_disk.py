"""A folder whose disk fails when it is told to, for this process and all that it starts."""

import ctypes
import errno
import mmap
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

SOURCE = Path(__file__).with_suffix(".c")
_PATH_MAX = 4096
_VARIABLE = "FAILING_DISK"


class Kind(IntEnum):
    """What is done to a file or folder; opening counts only where it is for writing."""

    OPEN = 0
    WRITE = 1
    TRUNCATE = 2
    SYNC = 3
    RENAME = 4
    UNLINK = 5
    MKDIR = 6
    RMDIR = 7
    LINK = 8
    SYMLINK = 9


class _Action(IntEnum):
    COUNT, FAIL, HALVE, KILL, TEAR = range(5)


def _mask(*kinds: Kind) -> int:
    return sum(1 << kind for kind in kinds)


_ALL = _mask(*Kind)
_GROWS = _mask(Kind.OPEN, Kind.WRITE, Kind.TRUNCATE, Kind.MKDIR, Kind.LINK, Kind.SYMLINK)
"""What needs space."""
_CHANGES = _ALL & ~_mask(Kind.SYNC)


@dataclass(frozen=True)
class Failure:
    """What happens at the operation with the number asked for.

    Attributes:
        meaning: for people.
        kinds: the kinds that are counted.
        kinds_after: the kinds that also fail ever after.
    """

    meaning: str
    action: _Action
    error: int
    kinds: int
    kinds_after: int = 0

    @property
    def kills(self) -> bool:
        """Whether the process ends there."""
        return self.action in (_Action.KILL, _Action.TEAR)


FAILURES = {
    "full": Failure("full from there on; a write is cut short", _Action.HALVE, errno.ENOSPC, _GROWS, _GROWS),
    "full once": Failure("full at that moment only", _Action.FAIL, errno.ENOSPC, _GROWS),
    "error once": Failure("one input/output error", _Action.FAIL, errno.EIO, _ALL),
    "gone": Failure("input/output errors from there on", _Action.FAIL, errno.EIO, _ALL, _ALL),
    "read-only": Failure("read-only from there on", _Action.FAIL, errno.EROFS, _CHANGES, _CHANGES),
    "kill": Failure("killed before it", _Action.KILL, 0, _ALL),
    "torn write": Failure("killed halfway through a write", _Action.TEAR, 0, _mask(Kind.WRITE)),
}
COUNTING = Failure("nothing", _Action.COUNT, 0, _ALL)


class _Control(ctypes.Structure):
    """`struct control` of failing_disk.c."""

    _fields_ = (
        ("armed", ctypes.c_uint64),
        ("at", ctypes.c_uint64),
        ("kinds", ctypes.c_uint64),
        ("kinds_after", ctypes.c_uint64),
        ("action", ctypes.c_uint32),
        ("error", ctypes.c_uint32),
        ("count", ctypes.c_uint64),
        ("lock", ctypes.c_uint32),
        ("folder", ctypes.c_char * _PATH_MAX),
        ("journal", ctypes.c_char * _PATH_MAX),
    )


_RECORD = struct.Struct("@IIIIqQ")


@dataclass(frozen=True)
class Operation:
    """One change of a file or folder.

    Attributes:
        path: what was changed; of a rename or link, the old name.
        other: the new name, or what a symlink points to.
        offset: of a write; the new size of a truncated file; 1 for opening that empties the file.
        data: the bytes written.
        failed: it changed nothing, such as making a folder that exists.
    """

    kind: Kind
    path: str
    other: str
    offset: int
    data: bytes
    failed: bool = False


class FailingDisk:
    """The control of the watched folder, for the process that was started by `start_over`."""

    def __init__(self, folder: Path) -> None:
        """Watch `folder`, whose disk is sound until `arm`."""
        with Path(os.environ[_VARIABLE]).open("r+b") as file:
            self._control = _Control.from_buffer(mmap.mmap(file.fileno(), ctypes.sizeof(_Control)))
        self._control.folder = os.fsencode(folder.resolve())

    def arm(self, failure: Failure, at: int = 0, journal: Path | None = None) -> None:
        """Let the `at`-th operation from now on fail; with `journal`, write down all operations there."""
        control = self._control
        control.armed = control.count = control.lock = 0
        control.at, control.action, control.error = at, failure.action, failure.error
        control.kinds, control.kinds_after = failure.kinds, failure.kinds_after
        control.journal = os.fsencode(journal or "")
        if journal:
            journal.write_bytes(b"")
        control.armed = 1

    def disarm(self) -> int:
        """Let the disk be sound again; return how many operations there were."""
        self._control.armed = 0
        return int(self._control.count)


def why_not() -> str | None:
    """Return why there can be no failing disk here, if so."""
    if sys.platform != "linux":
        return "LD_PRELOAD is tried on Linux alone"
    try:
        subprocess.run(["cc", "--version"], capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "no C compiler (cc)"
    return None


def start_over(make_folder: Callable[[], Path]) -> None:
    """Replace this process by one with the same arguments whose disk can fail; return if it is that one."""
    if _VARIABLE in os.environ:
        return
    folder = make_folder()
    library, control = folder / "failing_disk.so", folder / "control"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, SOURCE, "-ldl"], check=True)
    control.write_bytes(bytes(ctypes.sizeof(_Control)))
    environment = os.environ | {"LD_PRELOAD": str(library), _VARIABLE: str(control)}
    os.execve(sys.executable, [sys.executable, *sys.argv], environment)


def workplace() -> Path:
    """Return the folder that `start_over` made."""
    return Path(os.environ[_VARIABLE]).parent


def read_journal(path: Path) -> Iterator[Operation]:
    """Yield what was written down since `arm`."""
    data, place = path.read_bytes(), 0
    while place < len(data):
        kind, path_length, other_length, failed, offset, length = _RECORD.unpack_from(data, place)
        place += _RECORD.size
        parts = []
        for size in (path_length, other_length, length):
            parts.append(data[place : place + size])
            place += size
        yield Operation(Kind(kind), os.fsdecode(parts[0]), os.fsdecode(parts[1]), offset, parts[2], bool(failed))
