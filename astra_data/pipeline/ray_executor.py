"""Items as tasks of a Ray cluster, whose machines share the run's folder and have astra-data installed.

An item computes there what it computes in a process of this machine: on a processor of the same kind, the
same bytes.
"""

import os
import platform
import sys
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

from astra_data.core.cores import cores
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.core.optional import optional
from astra_data.pipeline.execution import (
    SECONDS_BETWEEN_NOTES,
    Item,
    Note,
    Watcher,
    pickled,
    run_in_order,
    run_item,
)

HERE = "local"
"""The address of a cluster of this machine alone, which starts and stops with the run."""
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
    address: str,
    jobs: int | None,
    logs: Path,
    watch: Watcher,
    prepare: Callable[[], object] | None = None,
) -> None:
    """Run `items` as `local_executor.execute` does, each as a task with one core of the cluster at `address`.

    Relative paths and modules mean the same on every machine: a task runs in this process's working folder
    and with its module search path.

    Args:
        items: in order of preference.
        address: of a running cluster, such as ray://head:10001 or head:6379; or `HERE`.
        jobs: number of tasks at a time, by default as many as the cluster has cores.
        logs: folder of the log files, one per item that printed something.
        watch: is notified of every start, progress and finish.
        prepare: called in each task before its item.

    Raises:
        BadInputError: Ray is not installed, no cluster answers, or it lacks the GPU that an item wants.
        AstraDataError: an item failed; its own error, with its key before the message, or where its
            traceback is when it crashed. Or the connection to the cluster was lost.
    """
    ray = _connect(address, jobs)
    running: dict[Any, str] = {}
    here = Path.cwd(), sys.path

    def begin(item: Item) -> None:
        share = GPU_SHARE if _wants_gpu(item) else 0
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
        if any(map(_wants_gpu, items)) and not ray.cluster_resources().get("GPU"):
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


def _wants_gpu(item: Item) -> bool:
    return item.device.startswith("cuda")


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
