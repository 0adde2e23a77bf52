"""What JSON and TOML hold, by its place."""

from collections.abc import Iterator
from typing import Any


def places(value: object, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of everything inside `value`, outer ones first."""
    if path:
        yield path
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield from places(value[key], (*path, key))  # type: ignore[index]
