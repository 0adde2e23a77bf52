"""CSV: one row per step, a header with the fields' names; read block by block."""

import codecs
import csv as python_csv
import io
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from astra_data.core.errors import BadInputError, in_short
from astra_data.core.naming import shortened
from astra_data.dataset.columns import Array
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import Block, Part, Source, row_count

SUFFIXES = (".csv", ".tsv")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE)
_MARKS = {";": "semicolons", "\t": "tabs", ",": "commas"}
_LIST = re.compile(r"\s*[\[(](.*)[\])]\s*", re.DOTALL)
_LONGEST_HEADER = 2**20
_SAVE = "save it as UTF-8"
_SHOWN = 80
"""Characters of a line above the header that are shown."""


def delimiter_of(name: str) -> tuple[str, str]:
    """Return what parts the fields of the file `name`, and what it is called."""
    return ("\t", "tabs") if name.lower().endswith(".tsv") else (",", "commas")


def check_header(name: str, stream: IO[bytes]) -> None:
    """Raise BadInputError if the file `name` is no UTF-8, or its header no names parted as it tells."""
    line = _first_line(stream)
    if line.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise BadInputError(f"{name}: expected text in UTF-8, got UTF-16: {_SAVE}")
    delimiter, mark = delimiter_of(name)
    first = line.decode("utf-8", "ignore" if len(line) == _LONGEST_HEADER else "strict")
    cells = [cell.strip().strip('"') for cell in first.split(delimiter)]
    # Of pandas, columns without names are called 0, 1, 2, ...
    if cells != [str(number) for number in range(len(cells))] and all(map(_NUMBER.fullmatch, cells)):
        names = delimiter.join(f"f{number}" for number in range(len(cells)))
        raise BadInputError(
            f"{name}: expected a header with a name for each field, got numbers: write one above the first "
            f"line, such as {shortened(names, _SHOWN)} (sed -i '1i NAMES' FILE)"
        )
    if delimiter not in first and (others := [other for part, other in _MARKS.items() if part in first]):
        raise BadInputError(
            f"{name}: expected fields parted by {mark}, got {others[0]} in its header: "
            "write it with commas, or with tabs as .tsv"
        )


def _first_line(stream: IO[bytes]) -> bytes:
    """Read the first line that is not empty, with its end."""
    while (line := stream.readline(_LONGEST_HEADER)) in (b"\n", b"\r\n"):
        pass
    return line


@contextmanager
def explained(name: str, source: Source) -> Iterator[None]:
    """Raise BadInputError with what makes the file `name` no CSV, in which line, and what to do."""
    try:
        yield
    except UnicodeDecodeError as error:
        found = f"the byte 0x{error.object[error.start]:02x}"
        raise BadInputError(f"{name}: expected text in UTF-8, got {found}: {_SAVE}") from None
    except pa.ArrowInvalid as error:
        if "UTF8" in str(error):
            raise BadInputError(f"{name}: expected text in UTF-8 ({in_short(error)}): {_SAVE}") from None
        with suppress(python_csv.Error), _lines(source) as lines:
            header = next(lines, (1, []))[1]
            for number, cells in lines:
                if len(cells) != len(header):
                    advice = "write as many fields there as in the header, or leave the line out"
                    if len(header) == 1 or header[0].startswith("#"):
                        advice = f"leave out what is above the header, {shortened(repr(header[0]), _SHOWN)}"
                    raise BadInputError(
                        f"{name} cannot be read as csv: line {number}: Expected {len(header)} columns, got "
                        f"{len(cells)}: {advice}"
                    ) from None
        raise BadInputError(f"{name}: expected CSV with a header ({in_short(error)})") from None


def line_of(source: Source, row: int) -> int:
    """Return the number of the line, from 1, of a row below the header, from 0; empty lines are no rows."""
    with suppress(python_csv.Error), _lines(source) as lines:
        return next(islice(lines, row + 1, None), (row + 2, []))[0]
    return row + 2


@contextmanager
def _lines(source: Source) -> Iterator[Iterator[tuple[int, list[str]]]]:
    """Open a file as its lines that are not empty: their numbers, from 1, and their cells."""
    with source.open() as stream, io.TextIOWrapper(stream, "utf-8", "replace", newline="") as text:
        reader = python_csv.reader(text, delimiter=delimiter_of(str(source))[0])
        yield ((reader.line_num, cells) for cells in reader if cells)


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows: whole numbers, numbers, lists, or true and false; an empty cell is NaN."""
    return _joined(source, mapping) if source.parts else _read(source, mapping.all_fields, mapping.fields)


def _joined(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows of the file that has the state, each with the last ones of the other files.

    Rows without such ones, or with ones older than `split.gap_s`, are left out, and an episode ends there.
    """
    time = mapping.time
    if time is None:
        raise BadInputError(f"{source}: files are joined by time: set `time` to the field with the times")
    if apart := [f for f in mapping.all_fields if f != time and f.partition(":")[0] not in source.parts]:
        raise BadInputError(f"{source}: {', '.join(apart)}: expected the file of each field, such as state.csv:x")
    numbers = [time, *_plain(mapping.fields)]
    main, *rest = mapping.files
    tables: dict[str, dict[str, Array]] = {}
    for name in (main, *rest):
        fields = [time, *_plain(f for f in mapping.all_fields if f.startswith(f"{name}:"))]
        blocks = [block.values for block in _read(source.parts[name], fields, numbers)]
        tables[name] = {
            f"{name}:{field}" if field != time else time: np.concatenate([each[field] for each in blocks])
            if blocks
            else np.empty(0)
            for field in fields
        }
    values = tables[main]
    now = values[time]
    is_known = np.isfinite(now)
    for name in rest:
        times = tables[name].pop(time)
        if not (np.diff(times) >= 0).all():
            raise BadInputError(f"{source.parts[name]}: '{time}' goes back or is missing: sort its rows by it")
        last = np.searchsorted(times, now, side="right") - 1
        is_known &= last >= 0
        gap = (mapping.split.gap_s or np.inf) / mapping.time_scale
        is_known[is_known] &= now[is_known] - times[last[is_known]] <= gap
        values |= {field: column[last] for field, column in tables[name].items() if len(times)}
    kept = np.flatnonzero(is_known)
    if len(now) and not len(kept):
        raise BadInputError(f"{source}: no row has rows of {', '.join(rest)} before it that are recent enough")
    for rows in np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1) if len(kept) else ():
        part = {field: column[rows] for field, column in values.items()}
        yield Block(
            part,
            str(source),
            starts=bool(rows[0] != kept[0]),
            line=lambda row: line_of(source.parts[main], int(kept[row])),
        )


def _plain(fields: Iterable[str]) -> list[str]:
    """Return the names of fields within their files."""
    return [field.partition(":")[2] for field in fields if ":" in field]


def _read(source: Source, fields: Sequence[str], numbers: Sequence[str]) -> Iterator[Block]:
    """Yield the rows of `fields`; those that are not among `numbers` stay text."""
    with source.open() as stream:
        first = stream.readline(_LONGEST_HEADER)
    if len(first) < _LONGEST_HEADER and b"\n" not in first and b"\r" not in first:
        return  # only just begun
    torn = torn_bytes(source)
    last: Block | None = None
    with explained(str(source), source), without_end(source, torn) as stream:
        known = _checked(source, fields, torn)
        # As text first, since the type of a column may change after its first block.
        reader = csv.open_csv(
            stream,
            parse_options=csv.ParseOptions(delimiter=delimiter_of(str(source))[0]),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(fields, pa.string()),
                strings_can_be_null=True,
                include_columns=fields,
            ),
        )
        row = 0
        for batch in reader:
            values: dict[str, Array] = {}
            for field in fields:
                if field in numbers:
                    values[field] = _numbers(batch.column(field), source, field, row)
                else:
                    values[field] = np.array(batch.column(field).to_pylist(), dtype=str)
            row += len(batch)
            if last is not None:
                yield last
            line = partial(line_of, source)
            last = Block(values, str(source), line=line, known=known) if len(batch) else None
    if last is not None:
        yield replace(last, torn=int(torn > 0))


def torn_bytes(source: Source) -> int:
    """Return how long a last line is that ends within a row, as where a battery went empty; 0 if it is whole.

    It has no end, and fewer fields than the header; with quotes it is left to the parser.
    """
    with source.open() as stream:
        first = _first_line(stream)
        begin, end = stream.tell(), stream.seek(0, os.SEEK_END)
        stream.seek(max(1, begin, end - _LONGEST_HEADER) - 1)
        _, line_end, tail = stream.read().replace(b"\r", b"\n").rpartition(b"\n")
    delimiter = delimiter_of(str(source))[0].encode()
    is_short = tail.count(delimiter) < first.count(delimiter)
    return len(tail) if line_end and is_short and b'"' not in first + tail else 0


@contextmanager
def without_end(source: Source, size: int) -> Iterator[IO[bytes]]:
    """Open a file for reading, without its last `size` bytes."""
    with source.open() as stream:
        if size:
            end = stream.seek(0, os.SEEK_END)
            stream.seek(0)
            yield io.BufferedReader(Part(stream, end - size))
        else:
            yield stream


def _checked(source: Source, fields: Sequence[str], torn: int) -> list[str]:
    with source.open() as stream:
        check_header(str(source), stream)
    with without_end(source, torn) as stream:
        options = csv.ParseOptions(delimiter=delimiter_of(str(source))[0])
        header = csv.open_csv(stream, parse_options=options).schema.names
    row_count(str(source), fields, dict.fromkeys(header, (0,)))
    doubled = sorted({name for name in fields if header.count(name) > 1})
    if doubled:
        raise BadInputError(f"{source}: the header has {', '.join(doubled)} more than once")
    return [name for name in header if name]


def _numbers(texts: pa.StringArray, source: Source, field: str, row: int) -> Array:
    """Return the numbers of a field's `texts`, without blanks around them; the first is in `row`."""
    trimmed = pc.utf8_trim_whitespace(texts)
    texts = pc.if_else(pc.equal(trimmed, ""), pa.scalar(None, pa.string()), trimmed)
    whole = [] if texts.null_count else [pa.int64()]  # An empty cell has no integer value.
    for kind in (*whole, pa.float64(), pa.bool_()):
        try:
            numbers = pc.cast(texts, kind)
        except pa.ArrowInvalid:
            continue
        if kind == pa.int64():
            return np.from_dlpack(numbers)
        return np.from_dlpack(numbers.cast(pa.float64()).fill_null(np.nan))
    if (lists := _lists(texts, source, field, row)) is not None:
        return lists
    cells = list(enumerate(texts.to_pylist()))
    words = [cell for cell in cells if cell[1] and not _NUMBER.fullmatch(cell[1])]
    number, text = ([cell for cell in words if cell[1].lower() not in ("true", "false")] or words or cells)[0]
    raise BadInputError(
        f"{source} line {line_of(source, row + number)}: field '{field}': "
        f"expected numbers, or true and false, got '{text}'"
    )


def _lists(texts: pa.StringArray, source: Source, field: str, row: int) -> Array | None:
    """Return the numbers (n, size) of cells that are lists, "[0.1, 2]" or "[0.1 2]"; None where none is."""
    cells = [_LIST.fullmatch(text or "") for text in texts.to_pylist()]
    if not any(cells):
        return None
    rows: list[list[float]] = []
    for number, cell in enumerate(cells):
        try:
            rows.append([float(word) for word in re.split(r"[,;\s]+", cell[1].strip()) if word] if cell else [])
        except ValueError:
            rows.append([])
        if not rows[-1] or len(rows[-1]) != len(rows[0]):
            found = shortened(str(texts[number]), _SHOWN)
            raise BadInputError(
                f"{source} line {line_of(source, row + number)}: field '{field}': expected a list of "
                f"{len(rows[0]) or 'some'} numbers as in the rows before, got '{found}'"
            )
    return np.array(rows)
