"""JSON: one object of fields with their rows, as the NAO's logs are, or an object a row, in a list or lines.

Fields of objects in objects have the names of both: `pose/x`.

The former is read whole, since JSON cannot be parsed in blocks; files larger than `LIMIT_BYTES` are refused.
Lines, of at most as many bytes, are read block by block.
"""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import batched, islice
from typing import IO, Any

import numpy as np

from astra_data.core.errors import BadInputError, in_short
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import BLOCK_ROWS, Block, Source, row_count

LINES = (".jsonl", ".ndjson")
SUFFIXES = (".json", ".log", *LINES)
LIMIT_BYTES = 2**28


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield all rows as one block, or lines in several."""
    if str(source).lower().endswith(LINES):
        yield from _read_lines(source, mapping)
        return
    with source.open() as stream:
        text = stream.read(LIMIT_BYTES + 1)
    if len(text) > LIMIT_BYTES:
        raise BadInputError(f"{source}: expected at most {LIMIT_BYTES // 2**20} MB of JSON, split the file")
    fields = json.loads(text, object_pairs_hook=_once)
    if isinstance(fields, list) and fields and all(isinstance(row, dict) for row in fields):
        yield from _read_rows(fields, source, mapping)
        return
    fields = _flat(fields)
    if not isinstance(fields, dict):
        raise BadInputError(f"{source}: expected an object of fields, got {type(fields).__name__}")
    shapes = {name: (len(rows),) if isinstance(rows, list) else () for name, rows in fields.items()}
    if row_count(str(source), mapping.all_fields, shapes):
        yield _block(fields, mapping, str(source))


def _read_rows(rows: list[dict[str, Any]], source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows of a list with an object each."""
    flat = [_flat(row) for row in rows]
    for number, row in enumerate(flat):
        row_count(f"{source} row {number}", mapping.all_fields, dict.fromkeys(row, (1,)))
    block = _block({name: [row[name] for row in flat] for name in mapping.all_fields}, mapping, str(source))
    yield replace(block, known=flat[0])


def _flat(value: Any) -> Any:  # noqa: ANN401 - any JSON
    """Return an object with the values of objects in it as fields of their own: {"a": {"b": 1}} has a/b."""
    if not isinstance(value, dict):
        return value
    flat: dict[str, Any] = {}
    for name, part in value.items():
        inner = _flat(part)
        is_object = isinstance(inner, dict)
        flat |= {f"{name}/{key}": each for key, each in inner.items()} if is_object else {name: part}
    return flat


def _read_lines(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows of lines with an object each; a last line that is cut off is left out and counted."""
    last: Block | None = None
    fields = mapping.all_fields
    with source.open() as stream:
        for lines in batched(enumerate(_lines(stream, source), start=1), BLOCK_ROWS):
            torn = int(_is_torn(lines[-1][1]))
            whole = [(number, line) for number, line in lines[: len(lines) - torn] if line.strip()]
            rows = [_row(line, f"{source} line {number}", fields) for number, line in whole]
            if rows:
                if last is not None:
                    yield last
                block = _block({name: [row[name] for row in rows] for name in fields}, mapping, str(source))
                last = replace(block, line=partial(_line_of, source), known=rows[0])
            if last is not None:
                last = replace(last, torn=torn)
    if last is not None:
        yield last


def _line_of(source: Source, row: int) -> int:
    """Return the number of the line, from 1, of a row, from 0; blank lines are no rows."""
    with source.open() as stream:
        lines = enumerate(_lines(stream, source), start=1)
        return next(islice((number for number, line in lines if line.strip()), row, None))


def _lines(stream: IO[bytes], source: Source) -> Iterator[bytes]:
    while line := stream.readline(LIMIT_BYTES + 1):
        if len(line) > LIMIT_BYTES:
            raise BadInputError(f"{source}: expected lines of at most {LIMIT_BYTES // 2**20} MB of JSON")
        yield line


def _row(line: bytes, origin: str, fields: Sequence[str]) -> dict[str, Any]:
    try:
        row = json.loads(line, object_pairs_hook=_once)
    except (ValueError, BadInputError) as error:
        raise BadInputError(f"{origin}: expected an object of fields ({in_short(error)})") from error
    if not isinstance(row, dict):
        raise BadInputError(f"{origin}: expected an object of fields, got {type(row).__name__}")
    row = _flat(row)
    if not all(name in row for name in fields):
        row_count(origin, fields, dict.fromkeys(row, (1,)))
    return dict(row)


def _block(fields: dict[str, list[Any]], mapping: ImportMapping, origin: str) -> Block:
    """Return the rows of the mapping's fields; null among numbers is NaN, as an empty cell of CSV is."""
    columns = {}
    for field in mapping.all_fields:
        try:
            values = np.array(fields[field])
        except ValueError:
            raise BadInputError(f"{origin}: field '{field}': expected as many values in each row") from None
        if values.dtype == object and all(isinstance(value, int | float | None) for value in values.flat):
            values = values.astype(float)
        columns[field] = values
    return Block(columns, origin, known=fields)


def _is_torn(line: bytes) -> bool:
    """Return whether a line has no end and is no JSON, as one that was written when a battery went empty."""
    try:
        json.loads(line)
    except ValueError:
        return bool(line.strip()) and not line.endswith(b"\n")
    return False


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object whose names are all different."""
    fields = dict(pairs)
    if len(fields) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        doubled = sorted(name for name, count in counts.items() if count > 1)
        raise BadInputError(f"an object has {', '.join(doubled)} more than once")
    return fields
