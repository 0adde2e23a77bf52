"""File locks on folders."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from astra_data.core.errors import BadInputError


@contextmanager
def held(folder: Path, *, wait: bool = False) -> Iterator[bool]:
    """Hold the lock of `folder`, which the system releases when the process ends; yield whether it is held.

    Args:
        folder: an existing folder.
        wait: wait while another process holds the lock, instead of yielding False.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_NONBLOCK)  # a pipe would wait for a writer
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        yield False
    else:
        yield True
    finally:
        os.close(handle)


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Hold the lock of a run's folder.

    Raises:
        BadInputError: another process holds it.
    """
    with held(folder) as ours:
        if not ours:
            raise BadInputError(f"{folder} is in use by another run: wait until it ends, or stop it")
        yield
