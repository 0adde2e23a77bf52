"""JSON: one object of fields with their rows, or an object a row, in a list or lines; nested names are `pose/x`."""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError, in_short
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import Block, Source, row_count

LINES = (".jsonl", ".ndjson")
SUFFIXES = (".json", ".log", *LINES)
LIMIT_BYTES = 2**28  # larger files of one object or list are refused, since these cannot be parsed in parts


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield all rows."""
    origin, names = str(source), mapping.all_fields
    if origin.lower().endswith(LINES):
        yield from _read_lines(source, names)
        return
    with source.open() as stream:
        text = stream.read(LIMIT_BYTES + 1)
    if len(text) > LIMIT_BYTES:
        raise BadInputError(f"{source}: expected at most {LIMIT_BYTES // 2**20} MB of JSON, split the file")
    fields = json.loads(text, object_pairs_hook=partial(_once, origin=f"{source}: "))
    if isinstance(fields, list) and fields and all(isinstance(row, dict) for row in fields):
        rows = [_picked(row, names, f"{source} row {number}") for number, row in enumerate(fields)]
        yield replace(_block(rows, names, origin), known=_flat(fields[0]))
        return
    if fields in ([], {}):
        raise BadInputError(f"{source} is empty: nothing was recorded, leave it out")
    fields = _flat(fields)
    if not isinstance(fields, dict):
        raise BadInputError(f"{source}: expected an object of fields, got {type(fields).__name__}")
    shapes = {name: (len(rows),) if isinstance(rows, list) else () for name, rows in fields.items()}
    if row_count(origin, names, shapes):
        yield replace(_block(zip(*(fields[name] for name in names), strict=True), names, origin), known=fields)


def _read_lines(source: Source, names: Sequence[str]) -> Iterator[Block]:
    """Yield the rows of lines with an object each; a last line that is cut off is left out and counted."""
    rows: list[list[Any]] = []
    numbers: list[int] = []
    known: dict[str, Any] = {}
    is_torn = False
    with source.open() as stream:
        for number, line in enumerate(stream, start=1):
            if not line.strip():
                continue
            numbers.append(number)
            origin = f"{source} line {number}"
            try:
                row = json.loads(line, object_pairs_hook=_once)
            except (ValueError, BadInputError) as error:
                is_torn = isinstance(error, ValueError) and not line.endswith(b"\n")
                if is_torn:
                    break
                raise BadInputError(f"{origin}: expected an object of fields ({in_short(error)})") from error
            if not isinstance(row, dict):
                raise BadInputError(f"{origin}: expected an object of fields, got {type(row).__name__}")
            known = known or _flat(row)
            rows.append(_picked(row, names, origin))
    if rows:
        yield replace(_block(rows, names, str(source)), torn=is_torn, known=known, line=numbers.__getitem__)


def _picked(row: dict[str, Any], names: Sequence[str], origin: str) -> list[Any]:
    flat = _flat(row)
    if not all(name in flat for name in names):
        row_count(origin, names, dict.fromkeys(flat, (1,)))
    return [flat[name] for name in names]


def _flat(value: Any) -> Any:
    """Return an object with the values of objects in it as fields of their own: {"a": {"b": 1}} has a/b."""
    if not isinstance(value, dict):
        return value
    flat: dict[str, Any] = {}
    for name, part in value.items():
        inner = _flat(part)
        is_object = isinstance(inner, dict)
        flat |= {f"{name}/{key}": each for key, each in inner.items()} if is_object else {name: part}
    return flat


def _block(rows: Iterable[Sequence[Any]], names: Sequence[str], origin: str) -> Block:
    """Return the rows of the fields `names`; null among numbers is NaN, as an empty cell of CSV is."""
    columns = {}
    for name, column in zip(names, zip(*rows, strict=True), strict=True):
        try:
            values = np.array(column)
        except ValueError:
            raise BadInputError(f"{origin}: field '{name}': expected as many values in each row") from None
        if values.dtype == object and all(isinstance(value, int | float | None) for value in values.flat):
            values = values.astype(float)
        columns[name] = values
    return Block(columns, origin)


def _once(pairs: list[tuple[str, Any]], origin: str = "") -> dict[str, Any]:
    """Return an object whose names are all different."""
    fields = dict(pairs)
    if len(fields) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        doubled = sorted(name for name, count in counts.items() if count > 1)
        raise BadInputError(f"{origin}an object has {', '.join(doubled)} more than once")
    return fields
