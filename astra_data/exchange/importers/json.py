"""JSON: one object that maps each field to its rows, as the NAO's logs are.

A file is read whole, since JSON cannot be parsed in blocks; files larger than `LIMIT_BYTES` are refused.
"""

import json
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.exchange.mapping import ImportMapping
from astra_data.exchange.recording import Block, Source, row_count

SUFFIXES = (".json", ".log")
LIMIT_BYTES = 2**28


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield all rows as one block.

    Raises:
        BadInputError: the file is too large or no object; fields are missing, doubled or differ in length.
    """
    with source.open() as stream:
        text = stream.read(LIMIT_BYTES + 1)
    if len(text) > LIMIT_BYTES:
        raise BadInputError(f"{source}: expected at most {LIMIT_BYTES // 2**20} MB of JSON, split the file")
    fields = json.loads(text, object_pairs_hook=_once)
    if not isinstance(fields, dict):
        raise BadInputError(f"{source}: expected an object of fields, got {type(fields).__name__}")
    shapes = {name: (len(rows),) if isinstance(rows, list) else () for name, rows in fields.items()}
    if row_count(str(source), mapping.all_fields, shapes):
        yield Block({field: np.array(fields[field]) for field in mapping.all_fields}, str(source))


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object whose names are all different."""
    fields = dict(pairs)
    if len(fields) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        doubled = sorted(name for name, count in counts.items() if count > 1)
        raise BadInputError(f"an object has {', '.join(doubled)} more than once")
    return fields
