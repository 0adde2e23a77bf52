"""Items for the scheduler that import nothing slow; spawned processes find them by name."""

import errno
import os
import signal
import time
from pathlib import Path

from astra_data.core.durable import held
from astra_data.core.errors import MissingStageError
from astra_data.core.progress import Progress
from astra_data.pipeline.executors import Event


def touch(path: Path, needs: tuple[Path, ...], *, progress: Progress) -> None:
    assert all(need.exists() for need in needs)
    progress(0.5, "half")
    path.touch()


def rendezvous(mine: Path, theirs: Path, *, progress: Progress) -> None:
    """Finish only if another item runs at the same time."""
    mine.touch()
    until = time.monotonic() + 20
    while not theirs.exists():
        assert time.monotonic() < until, "the other item did not start"
        time.sleep(0.01)


def fail(*, progress: Progress) -> None:
    raise MissingStageError("nothing to eat")


def crash(*, progress: Progress) -> None:
    print("about to crash")
    raise ValueError("a bug")


def kill_itself(*, progress: Progress) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def leave(*, progress: Progress) -> None:
    os._exit(3)


def hang(path: Path, *, progress: Progress) -> None:
    """Hold the lock of the folder of `path` while hanging."""
    with held(path.parent):
        path.write_text(str(os.getpid()))
        time.sleep(600)


class Record:
    def __init__(self) -> None:
        self.events: list[tuple[str, str]] = []

    def __call__(self, key: str, event: Event) -> None:
        match event:
            case tuple():
                told = f"{event[0]} {event[1]}"
            case float():
                assert event >= 0
                told = "finished"
            case _:
                told = "started" if event is None else "failed"
        self.events.append((told, key))


def fill_the_disk(*, progress: Progress) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


_PIECES: list[object] = []


def free_much(progress: object) -> None:
    """Free 256 MB in pieces of 64 kB, between others that are kept, so that the allocator keeps all."""
    pieces = [bytearray(64_000) for _ in range(4000)]
    _PIECES.extend(pieces[::100])


def measure(path: Path, progress: object) -> None:
    """Write how many pages of memory this process takes."""
    path.write_text(Path("/proc/self/statm").read_text().split()[1])
