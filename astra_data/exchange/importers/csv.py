"""CSV: one row per step, a header with the fields' names; read block by block."""

import codecs
import csv as python_csv
import io
import os
from collections.abc import Iterator
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
from astra_data.core.wording import shortened
from astra_data.dataset.columns import Array
from astra_data.exchange.mapping import ImportMapping
from astra_data.exchange.recording import Block, Part, Source, row_count

SUFFIXES = (".csv", ".tsv")
_MARKS = {";": "semicolons", "\t": "tabs", ",": "commas"}
_LONGEST_HEADER = 2**20
_SAVE = "save it as UTF-8"
_SHOWN = 80
"""Characters of a line above the header that are shown."""


def delimiter_of(name: str) -> tuple[str, str]:
    """Return what parts the fields of the file `name`, and what it is called."""
    return ("\t", "tabs") if name.lower().endswith(".tsv") else (",", "commas")


def check_header(name: str, stream: IO[bytes]) -> None:
    """Refuse the file `name`, read from its beginning, if its header is no UTF-8 or is parted by other marks.

    Raises:
        BadInputError: it is; says by which.
    """
    line = _first_line(stream)
    if line.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise BadInputError(f"{name}: expected text in UTF-8, got UTF-16: {_SAVE}")
    delimiter, mark = delimiter_of(name)
    first = line.decode("utf-8", "ignore" if len(line) == _LONGEST_HEADER else "strict")
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
    """Say of the file `name` what makes it no CSV, in which line, and what to do.

    Raises:
        BadInputError: what was raised in place of it.
    """
    try:
        yield
    except UnicodeDecodeError as error:
        found = f"the byte 0x{error.object[error.start]:02x}"
        raise BadInputError(f"{name}: expected text in UTF-8, got {found}: {_SAVE}") from None
    except pa.ArrowInvalid as error:
        if "UTF8" in str(error):
            raise BadInputError(f"{name}: expected text in UTF-8 ({in_short(error)}): {_SAVE}") from None
        if fault := _uneven_line(source):
            raise BadInputError(f"{name} cannot be read as csv: {fault}") from None
        raise BadInputError(f"{name}: expected CSV with a header ({in_short(error)})") from None


def _uneven_line(source: Source) -> str:
    """Say which line has more or fewer fields than the header, and what to do; nothing where none does."""
    with suppress(python_csv.Error), _lines(source) as lines:
        header = next(lines, (1, []))[1]
        for number, cells in lines:
            if len(cells) == len(header):
                continue
            advice = "write as many fields there as in the header, or leave the line out"
            if len(header) == 1 or header[0].startswith("#"):
                advice = f"leave out what is above the header, {shortened(repr(header[0]), _SHOWN)}"
            return f"line {number}: Expected {len(header)} columns, got {len(cells)}: {advice}"
    return ""


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
    """Yield the rows; fields are whole numbers, numbers, or true and false, and an empty cell is NaN.

    Raises:
        BadInputError: fields are missing, duplicated or not numeric.
    """
    if _is_cut_in_header(source):
        return
    torn = torn_bytes(source)
    last: Block | None = None
    with explained(str(source), source), without_end(source, torn) as stream:
        known = _checked(source, mapping, torn)
        # As text first, since the type of a column may change after its first block.
        reader = csv.open_csv(
            stream,
            parse_options=csv.ParseOptions(delimiter=delimiter_of(str(source))[0]),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(mapping.all_fields, pa.string()),
                strings_can_be_null=True,
                include_columns=mapping.all_fields,
            ),
        )
        row = 0
        for batch in reader:
            values: dict[str, Array] = {}
            for field in mapping.all_fields:
                if field in mapping.fields:
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


def _is_cut_in_header(source: Source) -> bool:
    """Return whether a file ends before the end of its first line, as one that was only just begun."""
    with source.open() as stream:
        first = stream.readline(_LONGEST_HEADER)
    return len(first) < _LONGEST_HEADER and b"\n" not in first and b"\r" not in first


def _checked(source: Source, mapping: ImportMapping, torn: int) -> list[str]:
    with source.open() as stream:
        check_header(str(source), stream)
    with without_end(source, torn) as stream:
        options = csv.ParseOptions(delimiter=delimiter_of(str(source))[0])
        header = csv.open_csv(stream, parse_options=options).schema.names
    row_count(str(source), mapping.all_fields, dict.fromkeys(header, (0,)))
    doubled = sorted({name for name in mapping.all_fields if header.count(name) > 1})
    if doubled:
        raise BadInputError(f"{source}: the header has {', '.join(doubled)} more than once")
    return [name for name in header if name]


def _numbers(texts: pa.StringArray, source: Source, field: str, row: int) -> Array:
    """Return the numbers of a field's `texts`, without blanks around them; the first is in `row`."""
    texts = without_blanks(texts)
    whole = [] if texts.null_count else [pa.int64()]  # An empty cell has no integer value.
    for kind in (*whole, pa.float64(), pa.bool_()):
        try:
            numbers = pc.cast(texts, kind)
        except pa.ArrowInvalid:
            continue
        if kind == pa.int64():
            return np.from_dlpack(numbers)
        return np.from_dlpack(numbers.cast(pa.float64()).fill_null(np.nan))
    cells = list(enumerate(texts.to_pylist()))
    odd = [cell for cell in cells if not any(_is(cell[1], kind) for kind in (pa.float64(), pa.bool_()))]
    number, text = (odd or [cell for cell in cells if not _is(cell[1], pa.float64())])[0]
    raise BadInputError(
        f"{source} line {line_of(source, row + number)}: field '{field}': "
        f"expected numbers, or true and false, got '{text}'"
    )


def without_blanks(texts: pa.StringArray | pa.ChunkedArray) -> pa.StringArray | pa.ChunkedArray:
    """Return cells without blanks around them; those of nothing else are empty."""
    trimmed = pc.utf8_trim_whitespace(texts)
    return pc.if_else(pc.equal(trimmed, ""), pa.scalar(None, pa.string()), trimmed)


def _is(text: str | None, kind: pa.DataType) -> bool:
    """Return whether a cell is empty or of a kind."""
    try:
        pc.cast(pa.array([text], pa.string()), kind)
    except pa.ArrowInvalid:
        return False
    return True
