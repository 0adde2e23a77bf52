"""Items of work and what runs them: parallel processes of this machine, or tasks of a Ray cluster."""

import ctypes
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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from graphlib import TopologicalSorter
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from threading import Thread, current_thread, main_thread
from types import FrameType
from typing import Any

import numpy as np

from astra_data.core.durable import disk_error
from astra_data.core.errors import AstraDataError, BadInputError, in_short, optional
from astra_data.core.naming import stage_of_key
from astra_data.core.progress import Progress
from astra_data.core.provenance import cores
from astra_data.core.seeding import derive
from astra_data.worlds.user_code import user_line

SECONDS_BETWEEN_NOTES = 0.1
CUDA_JOBS = 2  # items at a time on a CUDA device, where each process has its own context
Note = tuple[float, str]  # the fraction of an item that is done, and a remark
Outcome = float | AstraDataError  # how long an item took, in s, or how it failed
Event = Outcome | Note | None  # what happened to an item: it ended, or went on, or None: it started
Watch = Callable[[str, Event], None]  # is called with the key of an item and what happened to it
GPU_SHARE = 0.5  # share of a GPU for an item that computes on one: two of them keep their CUDA contexts on one GPU
SETTINGS = {"RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0", "RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
"""Otherwise Ray makes `uv run` build an environment for every worker, sends usage statistics, and runs
its workers at a lower priority than every other process."""
PATIENCE_S = 10  # how long to wait for canceled tasks


@dataclass(frozen=True)
class Item:
    """One artifact to make, in another process: `call` is picklable and takes `progress`."""

    key: str  # its name and its path in the run's folder: `<stage>/[<method>/]seed_<seed>`, or `report`
    inputs: tuple[str, ...]  # keys of the artifacts that it reads
    call: Callable[..., object]
    is_threaded: bool = False  # whether `call` also takes `num_threads` and runs faster with more of them
    device: str = "cpu"
    settings: Mapping[str, Any] = field(default_factory=dict)  # what it is made with beside its inputs, as JSON

    @property
    def stage(self) -> str:
        """The stage that makes it."""
        return stage_of_key(self.key)

    @property
    def wants_gpu(self) -> bool:
        """Whether it computes on a GPU."""
        return self.device.startswith("cuda")


def run_in_order(
    items: Collection[Item],
    jobs: int | None,
    watch: Watch,
    begin: Callable[[Item], object],
    events: Callable[[], Iterable[tuple[str, Event]]],
) -> None:
    """Begin each item, in order of preference, as soon as its inputs are finished, at most `jobs` at a time.

    Inputs that are not among the items count as finished. `begin` returns at once; `events` returns what has
    happened since, by key. The error of an item that failed is raised.
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
        for key, event in events():
            watch(key, event)
            if isinstance(event, AstraDataError):
                raise event
            if isinstance(event, float):
                order.done(key)
                running -= 1


def pickled(item: Item, prepare: Callable[[], object] | None, num_threads: int = 1) -> bytes:
    """Return the work of `item` for `run_item`; if it steps the target's physics, by so many threads.

    The call is unpickled after `prepare`, which runs the user's file that defines classes of its settings.
    """
    call = partial(item.call, num_threads=num_threads) if item.is_threaded else item.call
    return pickle.dumps((prepare, pickle.dumps(call)))


def run_item(key: str, work: bytes, log: Path, send: Callable[[Note], object]) -> Outcome:
    """Run the `work` of an item in this process; return its wall-clock time in s, or its error.

    The global generators of Python, numpy and torch are seeded by its key. What it prints goes to `log`, which
    is removed if that is nothing.
    """
    began = time.perf_counter()
    with _printing_to(log.absolute()):
        try:
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
            sys.stdout.flush()
        except Exception as error:  # noqa: BLE001 - reported by the run, whatever it is
            if not isinstance(error, AstraDataError):
                with suppress(OSError):
                    traceback.print_exc()
            if expected := error if isinstance(error, AstraDataError) else disk_error(error):
                return type(expected)(f"{key}: {expected}")
            last = traceback.format_exception_only(error)[-1].strip()
            where = f"{line}; " if (line := user_line(error)) else ""
            return AstraDataError(f"{key} crashed: {last} ({where}traceback: {log})")
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
        for printed in (sys.stdout, sys.stderr):
            with suppress(OSError):
                printed.flush()

    flush()
    before = os.dup(1), os.dup(2)
    with log.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    try:
        yield
    finally:
        flush()
        for number, stream in enumerate(before, 1):
            os.dup2(stream, number)
            os.close(stream)
        if not log.stat().st_size:
            log.unlink()


def execute(
    items: Collection[Item],
    *,
    logs: Path,
    watch: Watch,
    jobs: int | None = None,
    prepare: Callable[[], object] | None = None,
    address: str | None = None,
) -> None:
    """Run `items` in spawned processes, each as soon as its inputs are finished.

    When an item fails, at Ctrl-C or SIGTERM, or when this process is killed, the others are stopped.
    What an item prints goes to `<key>.txt` in `logs`. `prepare` is called in the process of an item before it.
    """
    jobs = jobs or (CUDA_JOBS if any(item.wants_gpu for item in items) else cores())
    counts = Counter(item.stage for item in items)
    workers: list[_Worker] = []

    def begin(item: Item) -> None:
        if (worker := next((one for one in workers if one.key is None), None)) is None:
            workers.append(worker := _Worker(prepare))
        num_threads = max(1, cores() // min(jobs, counts[item.stage]))
        worker.begin(item.key, pickled(item, prepare, num_threads), logs / f"{item.key}.txt")

    def events() -> list[tuple[str, Event]]:
        busy = {worker.connection: worker for worker in workers if worker.key}
        ready = wait(list(busy))
        return [worker.read() for connection, worker in busy.items() if connection in ready]

    # Python tells no other thread of signals. A shell that starts a run in the background has it ignore SIGINT.
    signals = (signal.SIGINT, signal.SIGTERM) if current_thread() is main_thread() else ()

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        for number in signals:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in signals}
    try:
        # While the first items are made alone, the others import what theirs will need.
        workers += [_Worker(prepare) for _ in range(min(jobs, max(counts.values(), default=0)))]
        run_in_order(items, jobs, watch, begin, events)
    finally:
        for worker in workers:
            worker.process.terminate()
        for worker in workers:
            worker.stop()
        for number, handler in before.items():
            signal.signal(number, handler)


class _Worker:
    """A process that runs one item after another: the one of `key`, if it is busy."""

    def __init__(self, prepare: Callable[[], object] | None) -> None:
        context = multiprocessing.get_context("spawn")
        self.key: str | None = None
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, prepare))
        # Ctrl-C reaches every process of the terminal; children ignore it and are stopped by this one.
        resource_tracker.ensure_running()  # its start unblocks the signal
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        self.process.start()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()

    def begin(self, key: str, work: bytes, log: Path) -> None:
        self.key = key
        with suppress(BrokenPipeError):  # `read` notices a process that died while it was idle
            self.connection.send((key, work, log))

    def read(self) -> tuple[str, Event]:
        assert self.key is not None
        key = self.key
        try:
            event = self.connection.recv()
        except (EOFError, ConnectionResetError):
            self.process.join()
            code = self.process.exitcode or 0
            how = f"ended its process with exit code {code}"
            if code < 0:
                reason = ", often for want of memory" if -code == signal.SIGKILL else ""
                how = f"was stopped by {signal.Signals(-code).name}{reason}"
            event = AstraDataError(f"{key} {how}")
        if isinstance(event, Outcome):
            self.key = None
        return key, event

    def stop(self) -> None:
        self.process.join(5)
        if self.process.exitcode is None:
            self.process.kill()
            self.process.join()
        self.connection.close()


def _serve(connection: Connection, _imported: Callable[[], object] | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a forked process would have the parent's handler
    parent = multiprocessing.parent_process()
    assert parent is not None

    def exit_with_parent() -> None:  # so that nothing works in a folder that is no longer locked
        parent.join()
        os._exit(1)

    Thread(target=exit_with_parent, daemon=True).start()
    while True:
        key, work, log = connection.recv()
        connection.send(None)
        outcome = run_item(key, work, log, connection.send)
        with suppress(OSError, AttributeError):  # glibc keeps what is freed: of 100 robots with meshes, a gigabyte
            ctypes.CDLL("libc.so.6").malloc_trim(0)
        connection.send(outcome)


def execute_on_cluster(
    items: Collection[Item],
    *,
    logs: Path,
    watch: Watch,
    jobs: int | None = None,
    prepare: Callable[[], object] | None = None,
    address: str | None = None,
) -> None:
    """Run `items` as `execute` does, each as a task with one core of the Ray cluster at `address`.

    By default one of this machine starts and stops with the run. A task runs in this process's working folder and
    with its module search path.
    """
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    ray: Any = optional("ray")
    local = {} if address else {"num_cpus": jobs or cores(), "include_dashboard": False}
    address = address or "local"
    try:
        ray.init(address, log_to_driver=False, logging_level="ERROR", **local)
    except (ConnectionError, RuntimeError, ValueError) as error:
        advice = "`ray status` lists clusters, `ray start --head` starts one"
        raise BadInputError(f"found no usable Ray cluster at {address}: {in_short(error)}; {advice}") from None
    running: dict[Any, str] = {}
    here = Path.cwd(), sys.path

    def begin(item: Item) -> None:
        share = GPU_SHARE if item.wants_gpu else 0
        log = logs / f"{item.key}.txt"
        begun = task.options(num_gpus=share).remote(item.key, pickled(item, prepare), log, here, mailbox)
        running[begun] = item.key

    def events() -> Iterator[tuple[str, Event]]:
        done, _ = ray.wait(list(running), timeout=SECONDS_BETWEEN_NOTES)
        yield from mailbox.get_nowait_batch(mailbox.qsize())
        for begun in done:
            key = running.pop(begun)
            try:
                yield key, ray.get(begun)
            except ray.exceptions.RayError as error:
                yield key, AstraDataError(f"{key} was lost with its worker: {in_short(error)}")

    try:
        if any(item.wants_gpu for item in items) and not ray.cluster_resources().get("GPU"):
            raise BadInputError(f"the Ray cluster at {address} has no GPU: use --device cpu")
        mailbox = optional("ray.util.queue").Queue(actor_options={"num_cpus": 0})  # the notes of tasks
        task = ray.remote(num_cpus=1, max_retries=0)(_work)
        run_in_order(items, jobs, watch, begin, events)
    except (ray.exceptions.RayError, ConnectionError) as error:
        raise AstraDataError(f"the Ray cluster at {address} was lost: {in_short(error)}") from None
    finally:
        with suppress(ray.exceptions.RayError, ConnectionError):
            for begun in running:
                ray.cancel(begun, force=True)
            if running:
                ray.wait(list(running), num_returns=len(running), timeout=PATIENCE_S)
        ray.shutdown()


def _work(key: str, work: bytes, log: Path, here: tuple[Path, list[str]], mailbox: Any) -> Outcome:  # noqa: ANN401 - Ray's
    folder, modules = here
    try:
        os.chdir(folder)
    except OSError as error:
        where = f"{platform.node()} cannot use {folder}, which all machines of the cluster must share"
        return AstraDataError(f"{key}: {where}: {error.strerror}")
    # A worker runs one task after another, so some may be in its search path already.
    sys.path.extend(place for place in modules if place not in sys.path)

    def send(note: Note | None) -> None:
        mailbox.put((key, note))  # waits, so that every note has arrived when the task ends

    send(None)
    return run_item(key, work, log, send)


EXECUTORS: dict[str, Callable[..., None]] = {"processes": execute, "ray": execute_on_cluster}
"""What runs items, by the names of `--engine`: each takes the arguments of `execute`."""
