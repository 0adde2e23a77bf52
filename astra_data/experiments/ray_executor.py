"""Items as tasks of a Ray cluster, whose machines share the run's folder and have astra-data installed.

An item computes there what it computes in a process of this machine: on a processor of the same kind, the
same bytes.
"""

import os
import pickle
import platform
import sys
import time
import traceback
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from astra_data.core.cores import cores
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.core.optional import optional
from astra_data.experiments.local_executor import SECONDS_BETWEEN_NOTES, Item, Reporter, Watcher

HERE = "local"
"""The address of a cluster of this machine alone, which begins and ends with the run."""
GPU_SHARE = 0.5
"""Of a GPU for an item that computes on one: two hold their contexts there side by side."""
SETTINGS = {
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",
}
"""Otherwise Ray has `uv run` build an environment for every worker, reports its use, and lets
its workers give way to every other process."""
PATIENCE_S = 10
"""How long cancelled tasks are waited for."""


def execute_on_cluster(
    items: Collection[Item],
    *,
    address: str,
    jobs: int | None,
    logs: Path,
    watch: Watcher,
    prepare: Callable[[], object] | None = None,
) -> None:
    """Run `items` as `schedule.execute` does, each as a task with one core of the cluster at `address`.

    Relative paths and modules mean the same on every machine: a task works in this process's working folder
    and looks for modules where it does.

    Args:
        items: in order of preference.
        address: of a running cluster, such as ray://head:10001 or head:6379; or `HERE`.
        jobs: number of tasks at a time, by default as many as the cluster has cores.
        logs: folder of the log files, one per item that printed something.
        watch: is told of every start, progress and finish.
        prepare: called in each task before its item.

    Raises:
        BadInputError: Ray is not installed, no cluster answers, or it lacks the GPU that an item wants.
        AstraDataError: an item failed; its own error, with its key before the message, or where its
            traceback is when it crashed. Or the cluster was lost.
    """
    ray = _connect(address, jobs)
    waiting = {item.key: item for item in items}
    unfinished = set(waiting)
    running: dict[Any, str] = {}
    try:
        if any(map(_wants_gpu, items)) and not ray.cluster_resources().get("GPU"):
            raise BadInputError(f"the Ray cluster at {address} has no GPU: use --device cpu")
        mailbox = ray.remote(num_cpus=0)(Mailbox).remote()
        task = ray.remote(num_cpus=1, max_retries=0)(_work)
        while unfinished:
            for item in [item for item in waiting.values() if unfinished.isdisjoint(item.inputs)]:
                if len(running) == jobs:
                    break
                del waiting[item.key]
                share = GPU_SHARE if _wants_gpu(item) else 0
                # Unpickled inside the task, when its log is in place.
                call = pickle.dumps((prepare, item.call))
                log = logs / f"{item.key}.txt"
                here = Path.cwd(), sys.path
                begun = task.options(num_gpus=share).remote(item.key, call, log, here, mailbox)
                running[begun] = item.key
            if not running:
                raise ValueError(f"items wait for each other: {', '.join(sorted(unfinished))}")
            done, _ = ray.wait(list(running), timeout=SECONDS_BETWEEN_NOTES)
            for key, note in ray.get(mailbox.take.remote()):
                _pass_on(key, note, watch)
            for task_id in done:
                key = running.pop(task_id)
                _finish(ray, task_id, key, watch)
                unfinished.discard(key)
    except (ray.exceptions.RayError, ConnectionError) as error:
        raise AstraDataError(f"the Ray cluster at {address} was lost: {_first_line(error)}") from None
    finally:
        _leave(ray, list(running))


class Mailbox:
    """An actor that keeps what tasks tell until it is taken."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._notes: list[tuple[str, tuple[float, str] | None]] = []

    def put(self, key: str, note: tuple[float, str] | None) -> None:
        """Keep a note on an item; None says that it has begun."""
        self._notes.append((key, note))

    def take(self) -> list[tuple[str, tuple[float, str] | None]]:
        """Return the notes since the last call, in their order."""
        notes, self._notes = self._notes, []
        return notes


def _connect(address: str, jobs: int | None) -> Any:  # noqa: ANN401 - the module
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    ray = optional("ray", "ray")
    local = {"num_cpus": jobs or cores(), "include_dashboard": False} if address == HERE else {}
    try:
        ray.init(address, log_to_driver=False, logging_level="ERROR", **local)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise BadInputError(
            f"no Ray cluster can be used at {address}: {_first_line(error)}; `ray status` tells which run, "
            "`ray start --head` starts one"
        ) from None
    return ray


def _leave(ray: Any, running: list[Any]) -> None:  # noqa: ANN401 - Ray's
    """Stop the tasks `running`, as far as the cluster is still there, and disconnect."""
    with suppress(ray.exceptions.RayError, ConnectionError):
        for task_id in running:
            ray.cancel(task_id, force=True)
        if running:
            ray.wait(running, num_returns=len(running), timeout=PATIENCE_S)
    ray.shutdown()


def _wants_gpu(item: Item) -> bool:
    return item.device.startswith("cuda")


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]


def _pass_on(key: str, note: tuple[float, str] | None, watch: Watcher) -> None:
    if note is None:
        watch.started(key)
    else:
        watch.progressed(key, *note)


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
    call: bytes,
    log: Path,
    here: tuple[Path, list[str]],
    mailbox: Any,  # noqa: ANN401 - Ray's
) -> float | AstraDataError:
    """Run an item; return its wall-clock time in s, or the error with which it failed."""
    # The tasks of a worker follow each other, and what they import stays.
    ray = sys.modules["ray"]
    folder, modules = here
    try:
        os.chdir(folder)
    except OSError as error:
        return AstraDataError(
            f"{key}: {platform.node()} cannot work in {folder}, which the machines of a cluster must share: "
            f"{error.strerror}"
        )
    sys.path.extend(place for place in modules if place not in sys.path)
    began = time.perf_counter()

    def tell(note: tuple[float, str] | None) -> None:
        # Waits, so that everything is in it when the task ends.
        ray.get(mailbox.put.remote(key, note))

    tell(None)
    with _printing_to(log):
        try:
            prepare, item = pickle.loads(call)
            if prepare:
                prepare()
            item(progress=Reporter(tell))
        except AstraDataError as error:
            return type(error)(f"{key}: {error}")
        except Exception as error:  # noqa: BLE001 - whatever it is, the run tells it
            traceback.print_exc()
            said = traceback.format_exception_only(error)[-1].strip()
            return AstraDataError(f"{key} crashed: {said} (traceback: {log})")
    return time.perf_counter() - began


@contextmanager
def _printing_to(log: Path) -> Iterator[None]:
    """Have everything that this process prints in `log`; remove it if that is nothing."""
    log.parent.mkdir(parents=True, exist_ok=True)
    _flush()
    before = os.dup(1), os.dup(2)
    with log.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    try:
        yield
    finally:
        _flush()
        for stream, own in zip((1, 2), before, strict=True):
            os.dup2(own, stream)
            os.close(own)
        if not log.stat().st_size:
            log.unlink()


def _flush() -> None:
    sys.stdout.flush()
    sys.stderr.flush()
