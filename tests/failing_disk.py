"""Disks that fill up, fail or are cut off, for tests."""

import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

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
def failing(names: str, at: int, error: BaseException, then: BaseException | None = None) -> Iterator[list[str]]:
    """Raise `error` at call `at` of the functions `names` of `os`, and `then` at all later ones.

    Yields the calls, in order.
    """
    calls: list[str] = []

    def counted(name: str, works: Callable[..., object], *arguments: object, **options: object) -> object:
        calls.append(name)
        if len(calls) == at + 1:
            raise error
        if then and len(calls) > at:
            raise then
        return works(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        for name in names.split():
            patch.setattr(os, name, partial(counted, name, getattr(os, name)))
        yield calls
