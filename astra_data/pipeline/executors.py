"""Items of work and what runs them: parallel processes of this machine, or tasks of a Ray cluster."""

import multiprocessing
import os
import pickle
import platform
import random
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from graphlib import TopologicalSorter
from multiprocessing.connection import Connection, wait
from pathlib import Path
from threading import Thread, current_thread, main_thread
from types import FrameType
from typing import Any, Protocol

import numpy as np

from astra_data.core.durable import disk_error
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.core.naming import stage_of_key
from astra_data.core.optional import optional
from astra_data.core.progress import Progress
from astra_data.core.provenance import cores
from astra_data.core.seeding import derive

SECONDS_BETWEEN_NOTES = 0.1
CUDA_JOBS = 2
"""Items at a time on a CUDA device, where each process has its own context."""
Note = tuple[float, str]
"""The fraction of an item that is done, and a remark."""
Outcome = float | AstraDataError
"""How long an item took, in s, or how it failed."""


@dataclass(frozen=True)
class Item:
    """One artifact to make.

    Attributes:
        key: its name and its path in the run's folder: `<stage>/[<method>/]seed_<seed>`, or `report`.
        inputs: keys of the artifacts that it reads.
        call: makes it; called as `call(progress=...)` in another process, so it must be picklable.
        is_threaded: whether `call` also takes `num_threads` and runs faster with more of them.
        device: torch device that it computes on.
        settings: what it is made with beside its inputs, as JSON.
    """

    key: str
    inputs: tuple[str, ...]
    call: Callable[..., object]
    is_threaded: bool = False
    device: str = "cpu"
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def stage(self) -> str:
        """The stage that makes it."""
        return stage_of_key(self.key)

    @property
    def wants_gpu(self) -> bool:
        """Whether it computes on a GPU."""
        return self.device.startswith("cuda")


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
    items: Collection[Item], jobs: int | None, begin: Callable[[Item], object], wait: Callable[[], Collection[str]]
) -> None:
    """Begin each item, in order of preference, as soon as its inputs are finished, at most `jobs` at a time.

    Inputs that are not among the items count as finished. `begin` starts an item and returns at once; `wait`
    returns the keys of the items that have finished since, possibly none.
    """
    keys = [item.key for item in items]
    order = TopologicalSorter({item.key: set(item.inputs).intersection(keys) for item in items})
    order.prepare()
    known, ready, running = {item.key: item for item in items}, list[str](), 0
    while order.is_active():
        ready = sorted([*ready, *order.get_ready()], key=keys.index)
        while ready and running != jobs:
            begin(known[ready.pop(0)])
            running += 1
        for key in wait():
            order.done(key)
            running -= 1


def pickled(item: Item, prepare: Callable[[], object] | None, num_threads: int = 1) -> bytes:
    """Return the work of `item` for `run_item`; if it steps the target's physics, by so many threads.

    The call is unpickled after `prepare`: it may hold settings of a class in a file of the user's, which only
    `prepare` runs.
    """
    call = partial(item.call, num_threads=num_threads) if item.is_threaded else item.call
    return pickle.dumps((prepare, pickle.dumps(call)))


def run_item(key: str, work: bytes, log: Path, send: Callable[[Note], object]) -> Outcome:
    """Run the `work` of an item in this process; return its wall-clock time in s, or its error.

    The global generators of Python, numpy and torch are seeded by its key: by stage, row and seed. What it
    prints goes to `log`, which is removed if that is nothing. At most ten notes a second are sent.
    """
    began = time.perf_counter()
    try:
        with _printing_to(log):
            prepare, call = pickle.loads(work)
            if prepare:
                prepare()
            made = pickle.loads(call)
            seed = derive(0, key)  # code of the user's may draw from the global generators
            random.seed(seed)
            np.random.seed(seed % 2**32)
            if torch := sys.modules.get("torch"):  # its import takes long
                torch.manual_seed(seed)
            made(progress=reporter(send))
    except Exception as error:  # noqa: BLE001 - reported by the run, whatever it is
        expected = error if isinstance(error, AstraDataError) else disk_error(error)
        if expected:
            return type(expected)(f"{key}: {expected}")
        last = traceback.format_exception_only(error)[-1].strip()
        return AstraDataError(f"{key} crashed: {last} (traceback: {log})")
    return time.perf_counter() - began


def reporter(send: Callable[[Note], object]) -> Progress:
    """Return the `progress` of an item, which sends at most ten notes a second."""
    following = 0.0

    def report(fraction: float, note: str) -> None:
        nonlocal following
        if (now := time.monotonic()) >= following:
            following = now + SECONDS_BETWEEN_NOTES
            send((fraction, note))

    return report


@contextmanager
def _printing_to(log: Path) -> Iterator[None]:
    """Redirect everything that this process prints to `log`; remove the file if that is nothing."""
    log.parent.mkdir(parents=True, exist_ok=True)

    def flush() -> None:
        sys.stdout.flush()
        sys.stderr.flush()

    flush()
    before = os.dup(1), os.dup(2)
    with log.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    try:
        yield
        flush()
    except AstraDataError:
        raise
    except Exception:
        with suppress(OSError):
            traceback.print_exc()
        raise
    finally:
        with suppress(OSError):
            flush()
        for stream, own in zip((1, 2), before, strict=True):
            os.dup2(own, stream)
            os.close(own)
        if not log.stat().st_size:
            log.unlink()


def execute(
    items: Collection[Item],
    *,
    logs: Path,
    watch: Watcher,
    jobs: int | None = None,
    prepare: Callable[[], object] | None = None,
    address: str | None = None,
) -> None:
    """Run `items` in spawned processes, each as soon as its inputs are finished.

    Those that step the target's physics share the cores. When an item fails, at Ctrl-C or SIGTERM, or when
    this process is killed, the others are stopped; their last checkpoints stay.

    Items are in order of preference; inputs that are not among them count as finished. What an item prints
    goes to `<key>.txt` in `logs`. By default there is a job per core, or `CUDA_JOBS` where an item wants a
    GPU. `prepare` is called in the process of an item before it.

    Raises:
        AstraDataError: an item failed; its own error, with its key before the message, or where its
            traceback is when it crashed.
        KeyboardInterrupt: at Ctrl-C or SIGTERM.
    """
    jobs = jobs or (CUDA_JOBS if any(item.wants_gpu for item in items) else cores())
    counts = Counter(item.stage for item in items)
    workers: list[_Worker] = []

    def begin(item: Item) -> None:
        if not (idle := [worker for worker in workers if worker.key is None]):
            workers.append(_Worker())
            idle = workers[-1:]
        num_threads = max(1, cores() // min(jobs, counts[item.stage]))
        idle[0].begin(item.key, pickled(item, prepare, num_threads), logs / f"{item.key}.txt")
        watch.started(item.key)

    def finished() -> list[str]:
        busy = {worker.connection: worker for worker in workers if worker.key}
        ready = wait(list(busy))
        keys = [worker.read(watch) for connection, worker in busy.items() if connection in ready]
        return [key for key in keys if key]

    signals = (signal.SIGINT, signal.SIGTERM)

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        for number in signals:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    # Also where a shell that started the run in the background has it ignore SIGINT.
    with _handled(signals, interrupt):
        try:
            run_in_order(items, jobs, begin, finished)
        finally:
            for worker in workers:
                worker.terminate()
            for worker in workers:
                worker.stop()


@contextmanager
def _handled(
    numbers: Collection[signal.Signals], handler: Callable[[int, FrameType | None], None] | signal.Handlers
) -> Iterator[None]:
    """Handle signals so within the block, where this is the main thread: Python tells no other of them."""
    ours = numbers if current_thread() is main_thread() else ()
    before = [signal.signal(number, handler) for number in ours]
    try:
        yield
    finally:
        for number, earlier in zip(ours, before, strict=True):
            signal.signal(number, earlier)


def _settle(key: str, outcome: Outcome, watch: Watcher) -> None:
    """Tell `watch` how an item ended; raise its error."""
    if isinstance(outcome, AstraDataError):
        watch.failed(key)
        raise outcome
    watch.finished(key, outcome)


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
        if isinstance(message, tuple):
            watch.progressed(key, *message)
            return None
        self.key = None
        _settle(key, message, watch)
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


GPU_SHARE = 0.5
"""Share of a GPU for an item that computes on one: two of them keep their CUDA contexts on one GPU."""
SETTINGS = {"RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0", "RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
"""Otherwise Ray makes `uv run` build an environment for every worker, sends usage statistics, and runs
its workers at a lower priority than every other process."""
PATIENCE_S = 10
"""How long to wait for canceled tasks."""


def execute_on_cluster(
    items: Collection[Item],
    *,
    logs: Path,
    watch: Watcher,
    jobs: int | None = None,
    prepare: Callable[[], object] | None = None,
    address: str | None = None,
) -> None:
    """Run `items` as `execute` does, each as a task with one core of the Ray cluster at `address`.

    That is such as ray://head:10001 or head:6379; by default one of this machine starts and stops with the
    run. A task runs in this process's working folder and with its module search path.

    Raises:
        BadInputError: Ray is not installed, no cluster answers, or it lacks the GPU that an item wants.
        AstraDataError: as `execute`, or the connection to the cluster was lost.
    """
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    ray: Any = optional("ray")
    local = {} if address else {"num_cpus": jobs or cores(), "include_dashboard": False}
    address = address or "local"
    try:
        ray.init(address, log_to_driver=False, logging_level="ERROR", **local)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise BadInputError(
            f"found no usable Ray cluster at {address}: {_first_line(error)}; `ray status` lists clusters, "
            "`ray start --head` starts one"
        ) from None
    running: dict[Any, str] = {}
    here = Path.cwd(), sys.path

    def begin(item: Item) -> None:
        share = GPU_SHARE if item.wants_gpu else 0
        log = logs / f"{item.key}.txt"
        begun = task.options(num_gpus=share).remote(item.key, pickled(item, prepare), log, here, mailbox)
        running[begun] = item.key

    def finished() -> list[str]:
        done, _ = ray.wait(list(running), timeout=SECONDS_BETWEEN_NOTES)
        for key, note in ray.get(mailbox.take.remote()):
            if note is None:
                watch.started(key)
            else:
                watch.progressed(key, *note)
        for begun in done:
            try:
                outcome = ray.get(begun)
            except ray.exceptions.RayError as error:
                outcome = AstraDataError(f"{running[begun]} was lost with its worker: {_first_line(error)}")
            _settle(running[begun], outcome, watch)
        return [running.pop(begun) for begun in done]

    try:
        if any(item.wants_gpu for item in items) and not ray.cluster_resources().get("GPU"):
            raise BadInputError(f"the Ray cluster at {address} has no GPU: use --device cpu")
        mailbox = ray.remote(num_cpus=0)(_Mailbox).remote()
        task = ray.remote(num_cpus=1, max_retries=0)(_work)
        run_in_order(items, jobs, begin, finished)
    except (ray.exceptions.RayError, ConnectionError) as error:
        raise AstraDataError(f"the Ray cluster at {address} was lost: {_first_line(error)}") from None
    finally:
        with suppress(ray.exceptions.RayError, ConnectionError):
            for begun in running:
                ray.cancel(begun, force=True)
            if running:
                ray.wait(list(running), num_returns=len(running), timeout=PATIENCE_S)
        ray.shutdown()


class _Mailbox:
    """An actor that keeps the notes of tasks, None of one that starts, until they are fetched."""

    def __init__(self) -> None:
        self._notes: list[tuple[str, Note | None]] = []

    def put(self, key: str, note: Note | None) -> None:
        self._notes.append((key, note))

    def take(self) -> list[tuple[str, Note | None]]:
        notes, self._notes = self._notes, []
        return notes


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]


def _work(key: str, work: bytes, log: Path, here: tuple[Path, list[str]], mailbox: Any) -> Outcome:  # noqa: ANN401 - Ray's
    """Run an item in a task of Ray's."""
    ray = sys.modules["ray"]
    folder, modules = here
    try:
        os.chdir(folder)
    except OSError as error:
        return AstraDataError(
            f"{key}: {platform.node()} cannot use {folder}, which all machines of the cluster must share: "
            f"{error.strerror}"
        )
    # A worker runs one task after another, so some may be in its search path already.
    sys.path.extend(place for place in modules if place not in sys.path)

    def send(note: Note | None) -> None:
        # Waits, so that every note has arrived when the task ends.
        ray.get(mailbox.put.remote(key, note))

    send(None)
    return run_item(key, work, log, send)


EXECUTORS: dict[str, Callable[..., None]] = {"processes": execute, "ray": execute_on_cluster}
"""What runs items, by the names of `--engine`: each takes the arguments of `execute`."""
