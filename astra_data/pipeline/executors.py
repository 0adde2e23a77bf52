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
from dataclasses import dataclass, field, replace
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
from astra_data.core.provenance import cores
from astra_data.core.seeding import derive

SECONDS_BETWEEN_NOTES = 0.1
CUDA_JOBS = 2
"""Items at a time on a CUDA device, where each process has its own context."""
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


def with_threads(item: Item, num_threads: int) -> Item:
    """Return `item`, to be made by `num_threads` threads if it steps the target's physics."""
    return replace(item, call=partial(item.call, num_threads=num_threads)) if item.is_threaded else item


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


def execute(
    items: Collection[Item],
    *,
    logs: Path,
    watch: Watcher,
    jobs: int | None = None,
    prepare: Callable[[], object] | None = None,
    address: str | None = None,
) -> None:
    """Run `items` in up to `jobs` spawned processes, each as soon as its inputs are finished.

    Those that step the target's physics share the cores.

    Inputs that are not among `items` count as finished. What an item prints goes to `<logs>/<key>.txt`; the
    file of an item that printed nothing is removed. When an item fails, at Ctrl-C or SIGTERM, or when this
    process is killed, the others are stopped; their last checkpoints stay.

    Args:
        items: in order of preference.
        logs: folder of the log files.
        watch: is notified of every start, progress and finish.
        jobs: number of processes; by default one per core, or `CUDA_JOBS` where an item wants a GPU.
        prepare: called in the process of an item before the item.
        address: None, as this machine has none.

    Raises:
        AstraDataError: an item failed; its own error, with its key before the message, or where its
            traceback is when it crashed.
        KeyboardInterrupt: at Ctrl-C or SIGTERM.
    """
    if address is not None:
        raise BadInputError("--address is for --engine ray: leave it out, or add that")
    jobs = jobs or (CUDA_JOBS if any(item.wants_gpu for item in items) else cores())
    counts = Counter(item.stage for item in items)
    workers: list[_Worker] = []

    def begin(item: Item) -> None:
        item = with_threads(item, max(1, cores() // min(jobs, counts[item.stage])))
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


HERE = "local"
"""Ray's address of a cluster of this machine alone."""
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

    Relative paths and modules mean the same on every machine: a task runs in this process's working folder
    and with its module search path.

    Args:
        items: in order of preference.
        logs: folder of the log files, one per item that printed something.
        watch: is notified of every start, progress and finish.
        jobs: number of tasks at a time, by default as many as the cluster has cores.
        prepare: called in each task before its item.
        address: of a running cluster, such as ray://head:10001 or head:6379; by default one of this machine
            starts and stops with the run.

    Raises:
        BadInputError: Ray is not installed, no cluster answers, or it lacks the GPU that an item wants.
        AstraDataError: an item failed; its own error, with its key before the message, or where its
            traceback is when it crashed. Or the connection to the cluster was lost.
    """
    items, address = [with_threads(item, 1) for item in items], address or HERE
    ray = _connect(address, jobs)
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
        for task_id in done:
            _finish(ray, task_id, running[task_id], watch)
        return [running.pop(task_id) for task_id in done]

    try:
        if any(item.wants_gpu for item in items) and not ray.cluster_resources().get("GPU"):
            raise BadInputError(f"the Ray cluster at {address} has no GPU: use --device cpu")
        mailbox = ray.remote(num_cpus=0)(Mailbox).remote()
        task = ray.remote(num_cpus=1, max_retries=0)(_work)
        run_in_order(items, jobs, begin, finished)
    except (ray.exceptions.RayError, ConnectionError) as error:
        raise AstraDataError(f"the Ray cluster at {address} was lost: {_first_line(error)}") from None
    finally:
        _leave(ray, list(running))


class Mailbox:
    """An actor that keeps the notes of tasks until they are fetched."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._notes: list[tuple[str, Note | None]] = []

    def put(self, key: str, note: Note | None) -> None:
        """Keep a note on an item; None means that it has started."""
        self._notes.append((key, note))

    def take(self) -> list[tuple[str, Note | None]]:
        """Return the notes since the last call, in their order."""
        notes, self._notes = self._notes, []
        return notes


def _connect(address: str, jobs: int | None) -> Any:  # noqa: ANN401 - the module
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    ray = optional("ray")
    local = {"num_cpus": jobs or cores(), "include_dashboard": False} if address == HERE else {}
    try:
        ray.init(address, log_to_driver=False, logging_level="ERROR", **local)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise BadInputError(
            f"found no usable Ray cluster at {address}: {_first_line(error)}; `ray status` lists clusters, "
            "`ray start --head` starts one"
        ) from None
    return ray


def _leave(ray: Any, running: list[Any]) -> None:  # noqa: ANN401 - Ray's
    """Cancel the tasks in `running`, if the cluster is still there, and disconnect."""
    with suppress(ray.exceptions.RayError, ConnectionError):
        for task_id in running:
            ray.cancel(task_id, force=True)
        if running:
            ray.wait(running, num_returns=len(running), timeout=PATIENCE_S)
    ray.shutdown()


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]


def _finish(ray: Any, task_id: Any, key: str, watch: Watcher) -> None:  # noqa: ANN401 - Ray's
    try:
        outcome = ray.get(task_id)
    except ray.exceptions.RayError as error:
        watch.failed(key)
        raise AstraDataError(f"{key} was lost with its worker: {_first_line(error)}") from None
    if isinstance(outcome, AstraDataError):
        watch.failed(key)
        raise outcome
    watch.finished(key, outcome)


def _work(
    key: str,
    work: bytes,
    log: Path,
    here: tuple[Path, list[str]],
    mailbox: Any,  # noqa: ANN401 - Ray's
) -> float | AstraDataError:
    """Run an item; return its wall-clock time in s, or the error with which it failed."""
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
