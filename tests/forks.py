"""Do something in a fork of this process, which has loaded what takes seconds."""

import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from typing import IO, Never


def forked(job: Callable[[], object], seconds: float | None = None) -> int:
    """Run `job` in a child that is killed after `seconds`; its exit status, negative if it was killed."""
    child = os.fork()
    if child == 0:
        job()
        os._exit(0)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def shown(command: Callable[[], object]) -> tuple[int, str]:
    """Run `command` in a child as an interpreter would; its exit code and all that it printed."""
    with tempfile.TemporaryFile("w+") as printed:
        child = os.fork()
        if child == 0:
            _become(command, printed)
        _, status = os.waitpid(child, 0)
        printed.seek(0)
        return os.waitstatus_to_exitcode(status), printed.read()


def _become(command: Callable[[], object], printed: IO[str]) -> Never:
    for stream in (1, 2):
        os.dup2(printed.fileno(), stream)
    code: object = 1
    try:
        command()
        code = 0
    except SystemExit as asked:
        code = asked.code or 0
    finally:
        if sys.exception() is not None:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code if isinstance(code, int) else 1)
