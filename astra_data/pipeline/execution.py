"""Items of work: what one is, the order in which they run, and how one is run; see the two executors."""

import os
import pickle
import random
import sys
import time
import traceback
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from astra_data.core.disk import disk_error
from astra_data.core.errors import AstraDataError
from astra_data.core.seeding import derive

SECONDS_BETWEEN_NOTES = 0.1
Note = tuple[float, str]
"""The fraction of an item that is done, and a remark."""


@dataclass(frozen=True)
class Item:
    """One artifact to make.

    Attributes:
        key: its name and its path in the run's folder: `<stage>/[<method>/]seed_<seed>`, or `report`.
        inputs: keys of the artifacts that it reads.
        call: makes it; called as `call(progress=...)` in another process, so it must be picklable.
        is_threaded: whether `call` also takes `num_threads` and runs faster with more of them.
        device: torch device that it computes on.
    """

    key: str
    inputs: tuple[str, ...]
    call: Callable[..., object]
    is_threaded: bool = False
    device: str = "cpu"


class Watcher(Protocol):
    """Is notified of the progress of items."""

    def started(self, key: str) -> None:
        """An item has started."""

    def progressed(self, key: str, fraction: float, note: str) -> None:
        """A `fraction` in [0, 1] of an item is done."""

    def finished(self, key: str, seconds: float) -> None:
        """An item has finished, after so many seconds of wall-clock time."""

    def failed(self, key: str) -> None:
        """An item has failed, perhaps before it started; the run stops."""


def run_in_order(
    items: Collection[Item],
    jobs: int | None,
    begin: Callable[[Item], object],
    wait: Callable[[], Collection[str]],
) -> None:
    """Begin each item as soon as its inputs are finished, at most `jobs` at a time.

    Args:
        items: in order of preference; inputs that are not among them count as finished.
        jobs: number of items at a time; None leaves the limit to `begin`.
        begin: starts an item and returns at once.
        wait: returns the keys of the items that have finished since, possibly none.

    Raises:
        ValueError: items wait for each other.
    """
    waiting = {item.key: item for item in items}
    unfinished = set(waiting)
    while unfinished:
        for item in [item for item in waiting.values() if unfinished.isdisjoint(item.inputs)]:
            if len(unfinished) - len(waiting) == jobs:
                break
            begin(waiting.pop(item.key))
        if len(waiting) == len(unfinished):
            raise ValueError(f"items wait for each other: {', '.join(sorted(unfinished))}")
        unfinished.difference_update(wait())


def pickled(item: Item, prepare: Callable[[], object] | None) -> bytes:
    """Return the work of `item` for `run_item`, to be unpickled only once its log file is in place.

    The call is unpickled after `prepare`: it may hold settings of a class in a file of the user's, which only
    `prepare` runs.
    """
    return pickle.dumps((prepare, pickle.dumps(item.call)))


def run_item(key: str, work: bytes, log: Path, send: Callable[[Note], object]) -> float | AstraDataError:
    """Run an item in this process; return its wall-clock time in s, or the error with which it failed.

    The global generators of Python, numpy and torch are seeded by its key: by stage, row and seed.

    Args:
        key: of the item.
        work: of `pickled`.
        log: file for what the item prints; removed if that is nothing.
        send: sends a note, at most ten times a second.
    """
    began = time.perf_counter()
    try:
        with _printing_to(log):
            prepare, call = pickle.loads(work)
            if prepare:
                prepare()
            made = pickle.loads(call)
            _seed_global_generators(key)
            made(progress=Reporter(send))
    except Exception as error:  # noqa: BLE001 - reported by the run, whatever it is
        expected = error if isinstance(error, AstraDataError) else disk_error(error)
        if expected:
            return type(expected)(f"{key}: {expected}")
        last = traceback.format_exception_only(error)[-1].strip()
        return AstraDataError(f"{key} crashed: {last} (traceback: {log})")
    return time.perf_counter() - began


def _seed_global_generators(key: str) -> None:
    """Let an item draw the same whatever ran before it: code of the user's may draw from these."""
    seed = derive(0, key)
    random.seed(seed)
    np.random.seed(seed % 2**32)
    if torch := sys.modules.get("torch"):  # its import takes long, and is of no use to what did without
        torch.manual_seed(seed)


class Reporter:
    """The `progress` of an item: sends at most ten notes a second."""

    def __init__(self, send: Callable[[Note], object]) -> None:
        self._send = send
        self._next = 0.0

    def __call__(self, fraction: float, note: str) -> None:
        """Send the fraction done and the note, unless another was sent just now."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + SECONDS_BETWEEN_NOTES
            self._send((fraction, note))


@contextmanager
def _printing_to(log: Path) -> Iterator[None]:
    """Redirect everything that this process prints to `log`; remove the file if that is nothing."""
    log.parent.mkdir(parents=True, exist_ok=True)
    _flush()
    before = os.dup(1), os.dup(2)
    with log.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    try:
        yield
        _flush()
    except AstraDataError:
        raise
    except Exception:
        with suppress(OSError):
            traceback.print_exc()
        raise
    finally:
        with suppress(OSError):
            _flush()
        for stream, own in zip((1, 2), before, strict=True):
            os.dup2(own, stream)
            os.close(own)
        if not log.stat().st_size:
            log.unlink()


def _flush() -> None:
    sys.stdout.flush()
    sys.stderr.flush()
