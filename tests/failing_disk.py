"""Disks that fill up, fail or are cut off, for tests."""

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest


class Killed(BaseException):
    """Stands for SIGKILL."""


@contextmanager
def small_files(most: int) -> Iterator[None]:
    """Let no file grow beyond `most` bytes, as `ulimit -f` does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def failing(names: str, at: int, error: BaseException, *, dead: bool = False) -> Iterator[list[str]]:
    """Raise `error` at call `at` of the functions `names` of `os`, if `dead` at all later ones too.

    Yields the calls, in order.
    """
    calls: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        for name in names.split():
            patch.setattr(os, name, _counted(name, getattr(os, name), calls, at, error, dead))
        yield calls


def _counted(name: str, works: Any, calls: list[str], at: int, error: BaseException, dead: bool) -> Any:  # noqa: ANN401
    def call(*arguments: Any, **options: Any) -> Any:  # noqa: ANN401
        calls.append(name)
        if len(calls) == at + 1 or (dead and len(calls) > at):
            raise error
        return works(*arguments, **options)

    return call
