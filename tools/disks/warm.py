"""Command lines that start at once: forked from a process that has imported everything."""

import ctypes
import gc
import importlib
import json
import multiprocessing
import os
import re
import select
import shlex
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py  # noqa: F401 - loads HDF5

import astra_data
from astra_data.cli.app import main
from astra_data.core.provenance import git_commit, package_versions

LIGHT = ("cli", "dataset", "io")
"""Rooms that commands on datasets need."""
WITH_TORCH = "dataset.frames"
"""The module of theirs that loads torch: a process with torch takes several times as long to fork."""
LIBRARIES = ("pandas", "fsspec.implementations.local")

_HDF5 = ctypes.CDLL(re.findall(r"/\S*libhdf5-\S+", Path("/proc/self/maps").read_text())[0])
"""The library that h5py has loaded."""


@dataclass(frozen=True)
class Outcome:
    """How a process ended.

    Attributes:
        status: its exit code; negative, the signal that ended it; None if it took too long and was killed.
        printed: both of its streams.
        answer: what its work returned, if it got so far.
    """

    status: int | None
    printed: str
    answer: Any = None

    @property
    def fault(self) -> str | None:
        """What is wrong with the way in which it ended: a hang, a crash, or more than one line of error."""
        errors = [line for line in self.printed.splitlines() if line.startswith("error: ")]
        if self.status is None:
            return "hang"
        if self.status not in (0, 1) or "Traceback" in self.printed or " crashed: " in self.printed:
            return "traceback"
        if self.status == 1 and not (errors and self.printed.rstrip().endswith(errors[-1])):
            return "traceback"
        return None


def warm_up(*, light: bool) -> None:
    """Import what commands import when they run, so that forked processes have it: all of it, or `LIGHT`."""
    top = Path(astra_data.__path__[0])
    for path in sorted(top.rglob("*.py")):
        name = path.relative_to(top).with_suffix("").as_posix().replace("/", ".").removesuffix("__init__").rstrip(".")
        is_wanted = name.startswith(LIGHT) and name != WITH_TORCH if light else "ray" not in name
        if is_wanted and name:
            importlib.import_module(f"astra_data.{name}")
    for library in LIBRARIES if light else (*LIBRARIES, "minari", "matplotlib.backends.backend_agg"):
        importlib.import_module(library)
    package_versions(), git_commit()
    # A recipe's own processes are forked too: a new interpreter would take seconds to import everything.
    forked = multiprocessing.get_context("fork")
    multiprocessing.get_context = lambda method=None: forked  # type: ignore[assignment]


def rehearse(work: Callable[[], object]) -> None:
    """Do `work` once in this process, so that forked ones find its caches filled."""
    caught(lambda: int(bool(work())))
    os.chdir("/")
    gc.collect()
    gc.freeze()


def forked(work: Callable[[], Any], seconds: float = 120.0) -> Outcome:
    """Do `work` in a process group of its own, which is killed after `seconds`.

    What `work` returns has to be JSON.
    """
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryFile() as answer:
        child = os.fork()
        if child == 0:
            os.setpgid(0, 0)
            for stream in (1, 2):
                os.dup2(printed.fileno(), stream)
            answer.write(json.dumps(_guarded(work)).encode())
            answer.flush()
            _leave(0)
        status = _wait(child, seconds)
        for file in (printed, answer):
            file.seek(0)
        text, found = printed.read().decode(errors="replace"), answer.read()
    return Outcome(status, text, json.loads(found) if found else None)


def command(line: str, folder: Path) -> int:
    """Run a command line in `folder` in this process, as its interpreter would; return the exit code."""
    os.chdir(folder)
    sys.argv = ["astra-data", *shlex.split(line)]
    try:
        main()
    except SystemExit as ending:
        return ending.code if isinstance(ending.code, int) else int(ending.code is not None)
    except BaseException:  # noqa: BLE001 - as the interpreter does
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


def caught(work: Callable[[], int]) -> tuple[int, str]:
    """Do `work` in this process; return its result and what it printed to either stream."""
    own = os.dup(1), os.dup(2)
    with tempfile.TemporaryFile() as printed:
        for stream in (1, 2):
            os.dup2(printed.fileno(), stream)
        result = work()
        for stream, before in zip((1, 2), own, strict=True):
            os.dup2(before, stream)
            os.close(before)
        printed.seek(0)
        return result, printed.read().decode(errors="replace")


def run(line: str, folder: Path, before: Callable[[], object] = int, seconds: float = 120.0) -> Outcome:
    """Run a command line in `folder` in a process of its own, after `before`."""

    def work() -> None:
        before()
        _leave(command(line, folder))

    return forked(work, seconds)


def _guarded(work: Callable[[], Any]) -> Any:  # noqa: ANN401 - JSON
    try:
        return work()
    except BaseException:  # noqa: BLE001 - shown by the parent
        traceback.print_exc()
        sys.stderr.flush()
        _leave(70)


def _leave(status: int) -> None:
    """End this process by way of HDF5's exit handler, which writes what it still holds.

    Those of other libraries write nothing, and take longer than a command.
    """
    _HDF5.H5close()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _wait(child: int, seconds: float) -> int | None:
    handle = os.pidfd_open(child)
    try:
        is_over = bool(select.select([handle], [], [], seconds)[0])
    finally:
        os.close(handle)
    # Also what it may have left behind.
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status) if is_over else None
