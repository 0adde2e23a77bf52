"""Do something in a fork of this process, which has loaded what takes seconds."""

import os
import tempfile
from collections.abc import Callable
from multiprocessing import get_context


def forked(job: Callable[[], object], seconds: float | None = None) -> int:
    """Run `job` in a child that is killed after `seconds`; its exit status, negative if it was killed."""
    child = get_context("fork").Process(target=job)
    child.start()
    child.join(seconds)
    child.kill()
    child.join()
    assert child.exitcode is not None
    return child.exitcode


def shown(command: Callable[[], object]) -> tuple[int, str]:
    """Run `command` in a child as an interpreter would; its exit code and all that it printed."""

    def redirected() -> None:
        for stream in (1, 2):
            os.dup2(printed.fileno(), stream)
        command()

    with tempfile.TemporaryFile("w+") as printed:
        code = forked(redirected)
        printed.seek(0)
        return code, printed.read()
