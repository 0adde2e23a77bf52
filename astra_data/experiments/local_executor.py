"""A small scheduler: items run in parallel processes, each as soon as its inputs are finished."""

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from threading import Thread
from typing import Protocol

from astra_data.core.errors import AstraDataError

SECONDS_BETWEEN_NOTES = 0.1


@dataclass(frozen=True)
class Item:
    """One artefact to make.

    Attributes:
        key: its name and its path in the run's folder: `<stage>/[<method>/]seed_<seed>`, or `report`.
        inputs: keys of the artefacts that it reads.
        call: makes it; called as `call(progress=...)` in another process, so it must be picklable.
        is_threaded: whether `call` also takes `num_threads`, which it works the faster with.
        device: torch device that it computes on.
    """

    key: str
    inputs: tuple[str, ...]
    call: Callable[..., object]
    is_threaded: bool = False
    device: str = "cpu"


class Watcher(Protocol):
    """What is told how the items get on."""

    def started(self, key: str) -> None:
        """Say that an item has begun."""

    def progressed(self, key: str, fraction: float, note: str) -> None:
        """Say that a `fraction` in [0, 1] of an item is done."""

    def finished(self, key: str, seconds: float) -> None:
        """Say that an item is finished, and its wall-clock time."""

    def failed(self, key: str) -> None:
        """Say that an item has failed, perhaps before it had begun; no other goes on."""


def execute(
    items: Collection[Item],
    *,
    jobs: int,
    logs: Path,
    watch: Watcher,
    prepare: Callable[[], object] | None = None,
) -> None:
    """Run `items`, at most `jobs` at a time, in freshly spawned processes.

    Inputs that are not among `items` count as finished. What an item prints goes to `<logs>/<key>.txt`; the
    file of an item that printed nothing is removed. When an item fails, at Ctrl-C, or when this process is
    killed, the others are stopped.

    Args:
        items: in order of preference.
        jobs: number of processes.
        logs: folder of the log files.
        watch: is told of every start, progress and finish.
        prepare: called once in each process, before its first item.

    Raises:
        AstraDataError: an item failed; its own error, with its key before the message, or where its
            traceback is when it crashed.
    """
    waiting = {item.key: item for item in items}
    unfinished = set(waiting)
    workers: list[_Worker] = []
    try:
        while unfinished:
            ready = [item for item in waiting.values() if unfinished.isdisjoint(item.inputs)]
            for item in ready:
                worker = next((worker for worker in workers if worker.item is None), None)
                if worker is None:
                    if len(workers) == jobs:
                        break
                    worker = _Worker(prepare)
                    workers.append(worker)
                worker.begin(waiting.pop(item.key), logs / f"{item.key}.txt")
                watch.started(item.key)
            busy = [worker for worker in workers if worker.item]
            if not busy:
                raise ValueError(f"items wait for each other: {', '.join(sorted(unfinished))}")
            speaking = wait([worker.connection for worker in busy])
            for worker in busy:
                if worker.connection in speaking:
                    unfinished.discard(worker.read(watch) or "")
    finally:
        for worker in workers:
            worker.stop()


class _Worker:
    """A process that runs one item after another."""

    def __init__(self, prepare: Callable[[], object] | None) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, prepare))
        # Ctrl-C reaches every process of the terminal: the child inherits that it is to leave it to us.
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            self._process.start()
        finally:
            signal.signal(signal.SIGINT, handler)
        theirs.close()
        self.item: Item | None = None
        self._log = Path()
        self._began = 0.0

    def begin(self, item: Item, log: Path) -> None:
        log.parent.mkdir(parents=True, exist_ok=True)
        log.unlink(missing_ok=True)
        self.item, self._log, self._began = item, log, time.perf_counter()
        # A process that died while it was idle is noticed by `read`.
        with suppress(BrokenPipeError):
            self.connection.send(log)
            self.connection.send(item.call)

    def read(self, watch: Watcher) -> str | None:
        """Pass on one message; return the item's key if it finished."""
        assert self.item is not None
        key = self.item.key
        try:
            message = self.connection.recv()
        except (EOFError, ConnectionResetError):
            watch.failed(key)
            raise AstraDataError(f"{key} {self._death()}") from None
        if isinstance(message, AstraDataError):
            watch.failed(key)
            raise type(message)(f"{key}: {message}")
        if message is not None:
            watch.progressed(key, *message)
            return None
        self.item = None
        watch.finished(key, time.perf_counter() - self._began)
        return key

    def _death(self) -> str:
        self._process.join()
        code = self._process.exitcode or 0
        if code < 0:
            reason = ", often for want of memory" if -code == signal.SIGKILL else ""
            return f"was stopped by {signal.Signals(-code).name}{reason}"
        if not self._log.exists():
            return f"could not start: exit code {code}"
        lines = self._log.read_text(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), f"exit code {code}")
        return f"crashed: {last} (traceback: {self._log})"

    def stop(self) -> None:
        self._process.terminate()
        self._process.join(5)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join()
        self.connection.close()


def _serve(connection: Connection, prepare: Callable[[], object] | None) -> None:
    Thread(target=_leave_with_parent, daemon=True).start()
    if prepare:
        prepare()
    while True:
        log: Path = connection.recv()
        with log.open("w") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        # The log is in place before the item's modules are imported, which is when they may warn.
        call: Callable[..., object] = connection.recv()
        try:
            call(progress=Reporter(connection.send))
        except AstraDataError as error:
            connection.send(error)
        else:
            sys.stdout.flush()
            sys.stderr.flush()
            if not log.stat().st_size:
                log.unlink()
            connection.send(None)


def _leave_with_parent() -> None:
    """Stop this process when its parent dies, so that nobody works in a folder that is no longer locked."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


class Reporter:
    """The `progress` of an item: sends at most ten notes a second."""

    def __init__(self, send: Callable[[tuple[float, str]], object]) -> None:
        self._send = send
        self._next = 0.0

    def __call__(self, fraction: float, note: str) -> None:
        """Send the fraction done and the note, unless another was sent just now."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + SECONDS_BETWEEN_NOTES
            self._send((fraction, note))
