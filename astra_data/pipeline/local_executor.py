"""Items in parallel processes of this machine."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from threading import Thread, current_thread, main_thread
from types import FrameType

from astra_data.core.errors import AstraDataError
from astra_data.pipeline.execution import Item, Watcher, pickled, run_in_order, run_item


def execute(
    items: Collection[Item],
    *,
    jobs: int,
    logs: Path,
    watch: Watcher,
    prepare: Callable[[], object] | None = None,
) -> None:
    """Run `items` in up to `jobs` spawned processes, each as soon as its inputs are finished.

    Inputs that are not among `items` count as finished. What an item prints goes to `<logs>/<key>.txt`; the
    file of an item that printed nothing is removed. When an item fails, at Ctrl-C or SIGTERM, or when this
    process is killed, the others are stopped; their last checkpoints stay.

    Args:
        items: in order of preference.
        jobs: number of processes.
        logs: folder of the log files.
        watch: is notified of every start, progress and finish.
        prepare: called in the process of an item before the item.

    Raises:
        AstraDataError: an item failed; its own error, with its key before the message, or where its
            traceback is when it crashed.
        KeyboardInterrupt: at Ctrl-C or SIGTERM.
    """
    workers: list[_Worker] = []

    def begin(item: Item) -> None:
        worker = next((worker for worker in workers if worker.key is None), None)
        if worker is None:
            worker = _Worker()
            workers.append(worker)
        worker.begin(item.key, pickled(item, prepare), logs / f"{item.key}.txt")
        watch.started(item.key)

    def finished() -> list[str]:
        busy = {worker.connection: worker for worker in workers if worker.key}
        ready = wait(list(busy))
        keys = [worker.read(watch) for connection, worker in busy.items() if connection in ready]
        return [key for key in keys if key]

    with _interruptible():
        try:
            run_in_order(items, jobs, begin, finished)
        finally:
            for worker in workers:
                worker.terminate()
            for worker in workers:
                worker.stop()


@contextmanager
def _interruptible() -> Iterator[None]:
    """Interrupt the block at SIGINT or SIGTERM, once.

    Also where a shell that started the run in the background has it ignore SIGINT.
    """
    numbers = (signal.SIGINT, signal.SIGTERM)

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    with _handled(numbers, interrupt):
        yield


@contextmanager
def _handled(
    numbers: Collection[signal.Signals], handler: Callable[[int, FrameType | None], None] | signal.Handlers
) -> Iterator[None]:
    """Handle signals so within the block.

    Python tells signals to the main thread alone: in another, nothing is changed.
    """
    ours = numbers if current_thread() is main_thread() else ()
    before = [signal.signal(number, handler) for number in ours]
    try:
        yield
    finally:
        for number, earlier in zip(ours, before, strict=True):
            signal.signal(number, earlier)


class _Worker:
    """A process that runs one item after another."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,))
        # Ctrl-C reaches every process of the terminal; children ignore it and are stopped by this one.
        with _handled([signal.SIGINT], signal.SIG_IGN):
            self._process.start()
        theirs.close()
        self.key: str | None = None

    def begin(self, key: str, work: bytes, log: Path) -> None:
        self.key = key
        # A process that died while it was idle is noticed by `read`.
        with suppress(BrokenPipeError):
            self.connection.send((key, work, log))

    def read(self, watch: Watcher) -> str | None:
        """Pass on one message; return the item's key if it finished."""
        assert self.key is not None
        key = self.key
        try:
            message = self.connection.recv()
        except (EOFError, ConnectionResetError):
            message = AstraDataError(f"{key} {self._death()}")
        if isinstance(message, AstraDataError):
            watch.failed(key)
            raise message
        if isinstance(message, tuple):
            watch.progressed(key, *message)
            return None
        self.key = None
        watch.finished(key, message)
        return key

    def _death(self) -> str:
        self._process.join()
        code = self._process.exitcode or 0
        if code >= 0:
            return f"ended its process with exit code {code}"
        reason = ", often for want of memory" if -code == signal.SIGKILL else ""
        return f"was stopped by {signal.Signals(-code).name}{reason}"

    def terminate(self) -> None:
        self._process.terminate()

    def stop(self) -> None:
        self._process.join(5)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join()
        self.connection.close()


def _serve(connection: Connection) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a forked process would have the parent's handler
    Thread(target=_exit_with_parent, daemon=True).start()
    while True:
        key, work, log = connection.recv()
        connection.send(run_item(key, work, log, connection.send))


def _exit_with_parent() -> None:
    """Exit when the parent process dies, so that nothing works in a folder that is no longer locked."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
