"""CSV: one row per step, a header with the fields' names."""

import codecs
import csv as python_csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from astra_data.core.errors import BadInputError, in_short
from astra_data.core.naming import shortened
from astra_data.dataset.columns import Array
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import Block, Source, row_count

SUFFIXES = (".csv", ".tsv")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE)
_MARKS = {";": "semicolons", "\t": "tabs", ",": "commas"}
_LIST = re.compile(r"\s*[\[(](.*)[\])]\s*", re.DOTALL)
_SAVE = "save it as UTF-8"
_HELD = 5  # periods of a joined file for which its last row may be held without a note
_SHOWN = 80  # characters of a line above the header that are shown


def delimiter_of(source: Source) -> str:
    """Return what parts the fields of a file."""
    return "\t" if str(source).lower().endswith(".tsv") else ","


def whole_lines(source: Source) -> tuple[bytes, bool]:
    """Return a file without a last line that ends within a row, and whether there was such a line.

    That line has no end and fewer fields than the header, or nothing in the last, as where a battery went empty;
    with quotes it is left to the parser. Raise BadInputError if the file is no UTF-8, or its header no names parted as
    its name tells.
    """
    with source.open() as stream:
        content = stream.read()
    header = re.match(rb"[\r\n]*([^\r\n]*)", content)[1]  # type: ignore[index]
    if header.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise BadInputError(f"{source}: expected text in UTF-8, got UTF-16: {_SAVE}")
    delimiter, first = delimiter_of(source), header.decode()
    cells = [cell.strip().strip('"') for cell in first.split(delimiter)]
    # Of pandas, columns without names are called 0, 1, 2, ...
    if cells != [str(number) for number in range(len(cells))] and all(map(_NUMBER.fullmatch, cells)):
        names = delimiter.join(f"f{number}" for number in range(len(cells)))
        advice = f"write one above the first line, such as {shortened(names, _SHOWN)} (sed -i '1i NAMES' FILE)"
        raise BadInputError(f"{source}: expected a header with a name for each field, got numbers: {advice}")
    if delimiter not in first and (others := [other for part, other in _MARKS.items() if part in first]):
        raise BadInputError(
            f"{source}: expected fields parted by {_MARKS[delimiter]}, got {others[0]} in its header: "
            "write it with commas, or with tabs as .tsv, and numbers with decimal points"
        )
    tail = content[max(content.rfind(b"\n"), content.rfind(b"\r")) + 1 :]
    mark = delimiter.encode()
    is_short = tail.count(mark) < header.count(mark) or tail.endswith(mark)
    is_torn = 0 < len(tail) < len(content) and is_short and b'"' not in header + tail
    return content[: len(content) - len(tail)] if is_torn else content, is_torn


@contextmanager
def explained(source: Source) -> Iterator[None]:
    """Raise BadInputError with what makes a file no CSV, in which line, and what to do."""
    try:
        yield
    except UnicodeDecodeError as error:
        found = f"the byte 0x{error.object[error.start]:02x}"
        raise BadInputError(f"{source}: expected text in UTF-8, got {found}: {_SAVE}") from None
    except pa.ArrowInvalid as error:
        if "UTF8" in str(error):
            raise BadInputError(f"{source}: expected text in UTF-8 ({in_short(error)}): {_SAVE}") from None
        with suppress(python_csv.Error), _lines(source) as lines:
            header = next(lines, (1, []))[1]
            for number, cells in lines:
                if len(cells) != len(header):
                    advice = "write as many fields there as in the header, or leave the line out"
                    if len(header) == 1 or header[0].startswith("#"):
                        advice = f"leave out what is above the header, {shortened(repr(header[0]), _SHOWN)}"
                    fault = f"Expected {len(header)} columns, got {len(cells)}: {advice}"
                    raise BadInputError(f"{source} cannot be read as csv: line {number}: {fault}") from None
        advice = "leave it out" if "Empty" in str(error) else _SAVE
        raise BadInputError(f"{source}: expected CSV with a header ({in_short(error)}): {advice}") from None


def line_of(source: Source, row: int) -> int:
    """Return the number of the line, from 1, of a row below the header, from 0; empty lines are no rows."""
    with suppress(python_csv.Error), _lines(source) as lines:
        return next(islice(lines, row + 1, None), (row + 2, []))[0]
    return row + 2


@contextmanager
def _lines(source: Source) -> Iterator[Iterator[tuple[int, list[str]]]]:
    """Open a file as its lines that are not empty: their numbers, from 1, and their cells."""
    with source.open() as stream, io.TextIOWrapper(stream, "utf-8", "replace", newline="") as text:
        reader = python_csv.reader(text, delimiter=delimiter_of(source))
        yield ((reader.line_num, cells) for cells in reader if cells)


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows: whole numbers, numbers, lists, or true and false; an empty cell is NaN."""
    if source.parts:
        yield from _joined(source, mapping)
    elif block := _read(source, mapping.all_fields, mapping.fields):
        yield block


def _joined(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows of the file with the state, each with the last ones of the others, up to `split.gap_s` old."""
    time = mapping.time
    if time is None:
        raise BadInputError(f"{source}: files are joined by time: set `time` to the field with the times")
    if apart := [f for f in mapping.all_fields if f != time and f.partition(":")[0] not in source.parts]:
        raise BadInputError(f"{source}: {', '.join(apart)}: expected the file of each field, such as state.csv:x")
    numbers = [time, *_plain(mapping.fields)]
    main, *rest = mapping.files
    tables: dict[str, dict[str, Array]] = {}
    torn = []
    for name in (main, *rest):
        fields = [time, *_plain(f for f in mapping.all_fields if f.startswith(f"{name}:"))]
        block = _read(source.parts[name], fields, numbers)
        torn += [name] if block and block.torn else []
        tables[name] = {
            f"{name}:{field}" if field != time else time: np.asarray(block.values[field]) if block else np.empty(0)
            for field in fields
        }
    values = tables[main]
    now = values[time]
    is_known, notes = np.ones(len(now), bool), list[str]()
    for name in rest:
        times = tables[name].pop(time)
        if not (np.diff(times) >= 0).all():
            raise BadInputError(f"{source.parts[name]}: '{time}' goes back or is missing: sort its rows by it")
        last = np.searchsorted(times, now, side="right") - 1
        is_known &= last >= 0
        held = now[is_known] - times[last[is_known]]
        usual, longest = np.median(np.diff(times)) if len(times) > 1 else np.inf, np.nanmax(held, initial=0)
        if mapping.split.gap_s is None and longest > _HELD * usual:
            every_s, most_s = mapping.time_scale * usual, mapping.time_scale * longest
            what = f"rows of {name}, which come every {every_s:.3g} s, hold for up to {most_s:.3g} s"
            notes.append(f"{what}: set split.gap_s, or compare the clocks of the files")
        # Rows without a time are refused, or left out, as those of a single file.
        is_known[is_known] &= ~(held > (mapping.split.gap_s or np.inf) / mapping.time_scale)
        values |= {field: column[last] for field, column in tables[name].items() if len(times)}
    kept = np.flatnonzero(is_known)
    if len(now) and not len(kept):
        advice = "compare the clocks of the files, or raise split.gap_s"
        raise BadInputError(f"{source}: no row has a recent enough one of {', '.join(rest)} before it: {advice}")
    begins = np.flatnonzero(np.diff(kept, prepend=-2) > 1).tolist()
    lost = f"left out {len(now) - len(kept)} rows without recent enough ones of {', '.join(rest)}"
    notes += [f"left out the last line of {name}, which is cut off" for name in torn if name != main]
    notes += [lost] if len(kept) < len(now) else []

    def line(row: int) -> int:
        return line_of(source.parts[main], int(kept[row]) if row < len(kept) else len(now))

    for first, rows in zip(begins, np.split(kept, begins[1:]), strict=False):
        part = {field: column[rows] for field, column in values.items()}
        is_torn = main in torn and first == begins[-1]
        yield Block(part, str(source), first > 0, is_torn, notes=() if first else tuple(notes), line=line, row=first)


def _plain(fields: Iterable[str]) -> list[str]:
    return [field.partition(":")[2] for field in fields if ":" in field]


def texts_of(source: Source, fields: Sequence[str] = ()) -> tuple[dict[str, pa.StringArray], bool, list[str]]:
    """Return the cells of `fields`, or of all; whether a last line is cut off and left out; and the names of all."""
    with explained(source):
        content, is_torn = whole_lines(source)
        options = csv.ParseOptions(delimiter=delimiter_of(source))
        header = csv.open_csv(io.BytesIO(content), parse_options=options).schema.names
        known = [name for name in header if name]
        if not known:
            raise BadInputError(f"{source}: expected a header with a name for each field, got none: write one")
        fields = fields or known
        row_count(str(source), fields, dict.fromkeys(header, (0,)))
        if doubled := sorted({name for name in fields if header.count(name) > 1}):
            raise BadInputError(f"{source}: the header has {', '.join(doubled)} more than once")
        kinds = dict.fromkeys(fields, pa.string())
        reading = csv.ConvertOptions(column_types=kinds, strings_can_be_null=True, include_columns=list(kinds))
        table = csv.read_csv(io.BytesIO(content), parse_options=options, convert_options=reading)
    return {name: table.column(name).combine_chunks() for name in kinds}, is_torn, known


def _read(source: Source, fields: Sequence[str], numbers: Sequence[str]) -> Block | None:
    """Return the rows of `fields`, None if there are none; those that are not among `numbers` stay text."""
    with source.open() as stream:
        if not re.search(rb"[\r\n]", stream.readline(2**20)):
            return None  # only just begun
    columns, is_torn, known = texts_of(source, fields)
    if not len(columns[fields[0]]):
        return None
    values = {
        name: numbers_of(cells, source, name) if name in numbers else np.array(cells.to_pylist(), dtype=str)
        for name, cells in columns.items()
    }
    return Block(values, str(source), torn=is_torn, line=partial(line_of, source), known=known)


def is_number(text: str) -> bool:
    """Return whether a cell holds a number, or true or false."""
    return bool(_NUMBER.fullmatch(text.strip())) or text.strip().lower() in ("", "true", "false")


def decimal_comma(text: str) -> str:
    """Return what to do about a cell that is a number with a decimal comma; empty for any other."""
    return ": write decimal points, as in 0.05" if re.fullmatch(r"\s*[+-]?\d*,\d+\s*", text) else ""


def numbers_of(texts: pa.StringArray, source: Source, field: str) -> Array:
    """Return the numbers of a field's `texts`, without blanks around them."""
    trimmed = pc.utf8_trim_whitespace(texts)
    texts = pc.if_else(pc.equal(trimmed, ""), pa.scalar(None, pa.string()), trimmed)
    whole = [] if texts.null_count else [pa.int64()]  # An empty cell has no integer value.
    for kind in (*whole, pa.float64(), pa.bool_()):
        with suppress(pa.ArrowInvalid):
            numbers = pc.cast(texts, kind)
            return np.from_dlpack(numbers if kind == pa.int64() else numbers.cast(pa.float64()).fill_null(np.nan))
    cells = texts.to_pylist()
    lists = [_LIST.fullmatch(text or "") for text in cells]
    if not any(lists):
        words = [row for row, cell in enumerate(cells) if cell and not _NUMBER.fullmatch(cell)]
        row = ([row for row in words if not is_number(cells[row])] or words or [0])[0]
        expected = f"numbers, or true and false, got '{cells[row]}'{decimal_comma(cells[row])}"
        raise BadInputError(f"{source} line {line_of(source, row)}: field '{field}': expected {expected}")
    rows: list[list[float]] = []  # of cells that are lists, "[0.1, 2]" or "[0.1 2]"
    for row, cell in enumerate(lists):
        try:
            rows.append([float(word) for word in re.split(r"[,;\s]+", cell[1].strip()) if word] if cell else [])
        except ValueError:
            rows.append([])
        if not rows[-1] or len(rows[-1]) != len(rows[0]):
            where = f"{source} line {line_of(source, row)}: field '{field}'"
            wanted = f"a list of {len(rows[0]) or 'some'} numbers as in the rows before"
            raise BadInputError(f"{where}: expected {wanted}, got '{shortened(str(texts[row]), _SHOWN)}'")
    return np.array(rows)
