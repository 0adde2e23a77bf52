"""How tests try random examples: ASTRA_DATA_FUZZ is how many of each kind; by default few, always the same."""

import os
from collections.abc import Iterator
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

Edit = tuple[float, bytes, bool]
shares = st.floats(0, 1, exclude_max=True)
edits = st.lists(st.tuples(shares, st.binary(max_size=8), st.booleans()), min_size=1, max_size=6)
"""Where, as a share of the file, bytes are overwritten or, if true, everything from there on is cut off."""


def fuzzed(examples: int) -> settings:
    return settings(
        max_examples=int(os.environ.get("ASTRA_DATA_FUZZ", examples)),
        deadline=None,
        derandomize="ASTRA_DATA_FUZZ" not in os.environ,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


def broken(content: bytes, changes: list[Edit]) -> bytes:
    for share, new, is_cut in changes:
        place = int(share * len(content))
        content = content[:place] + new + (b"" if is_cut else content[place + len(new) :])
    return content


def places(value: object, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of everything inside `value`, outer ones first."""
    if path:
        yield path
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield from places(value[key], (*path, key))  # type: ignore[index]
