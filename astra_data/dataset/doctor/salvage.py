"""Read the intact episodes of a damaged dataset, from files with or without a footer."""

import io
import mmap
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.errors import CorruptDatasetError, in_short
from astra_data.dataset import columns as names
from astra_data.dataset import plain
from astra_data.dataset.description import Digests, alteration, altered_columns
from astra_data.dataset.format import INFO_PATH
from astra_data.dataset.parquet import UNREADABLE

_DATA, _DICTIONARY, _DATA_V2 = 0, 2, 3
_DETAILS = {_DATA: 5, _DICTIONARY: 7, _DATA_V2: 8}
"""Field of a page's header with the details of this kind of page."""
_ENCODING = {_DATA: 2, _DICTIONARY: 2, _DATA_V2: 4}
"""Field of these details with the encoding."""
_FIXED_WIDTH = (0, 9)
"""Encodings PLAIN and BYTE_STREAM_SPLIT."""
_HEADER = 1000
"""Upper bound of a page header in bytes, including the extremes of its values."""
_SNAPPY, _ZSTD = 1, 6
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
TRUE, FALSE, BYTE, I16, I32, I64 = range(1, 7)
BINARY, LIST, STRUCT = 8, 9, 12
Struct = dict[int, tuple[int, Any]]


def whole_runs(
    folder: Path,
    columns: Sequence[plain.PlainColumn],
    digests: Digests,
    fps: int,
    notes: list[str],
    *,
    repeated: bool = False,
) -> Iterator[tuple[int, plain.Run]]:
    """Yield the uid and the rows of each intact episode; add to `notes` which were left out, and why.

    Without `digests` altered episodes cannot be told from whole ones. With `repeated`, episodes whose uid an
    earlier one has are yielded, too.

    An episode after rows that are lost is known by its own number and rows, where they agree with
    meta/episodes or, without that, where both are greater than those that should follow.
    """
    info = plain.read_object(folder / INFO_PATH)
    places, faults = plain.read_places(folder, info if isinstance(info, dict) else {})
    notes += [f"meta/episodes was rebuilt from the data: {fault}" for fault in faults]
    if not places and not faults:
        notes.append("meta/episodes was missing and was rebuilt from the data")
    notes += [f"{name} is missing" for name in plain.missing_files(folder, places)]
    counted = info.get("total_episodes") if isinstance(info, dict) else None
    most = len(next(iter(digests.values()))) if digests else counted if isinstance(counted, int) else 2**31
    episode = row = 0
    uids: set[int] = set()
    for run, is_cut in _every_run(folder, columns, notes):
        number, first, frame = _claimed(run)
        place = places.get(number)
        if frame > 0 or (is_cut and (place is None or place.length != len(run))):
            continue  # a part of an episode whose other rows are lost
        is_known = place is not None and place.length == len(run) and place.first_row in (None, first)
        if place is None and number < most:
            is_known = (number > episode and first > row) or (number < episode and first < row)
        if is_known and number < episode:
            notes.append(
                f"left out rows {run.row} to {run.row + len(run) - 1} of {_name(run.path)}: "
                f"they are of episode {number} once more"
            )
            continue
        if is_known and number > episode:
            notes.append(_lost(episode, number - 1))
            episode, row = number, first
        faults = [fault for _, fault in plain.run_faults(run, number=episode, row=row, fps=fps)]
        if (place := places.get(episode)) and place.length != len(run):
            faults.append(f"it has {len(run)} frames, expected {place.length}")
        if episode >= most and digests:
            faults.append(f"expected {most} episodes")
        faults += plain.flag_faults(run.columns, f"episode {episode} ")
        if altered := altered_columns(run.columns, episode, digests):
            faults.append(alteration(altered, run.path, run.row, len(run), episode))
        uid = int(run.columns.get(names.EPISODE_UID, [episode])[0])
        if uid < 0 or (uid in uids and not repeated):
            faults.append(f"its uid {uid} is taken or negative")
        if faults:
            notes.append(f"left out episode {episode}: {'; '.join(faults)}")
        else:
            uids.add(uid)
            yield uid, run
        episode, row = episode + 1, row + len(run)
    if places and episode <= max(places):
        notes.append(_lost(episode, max(places)))


def _claimed(run: plain.Run) -> tuple[int, int, int]:
    """Return the episode, the first row in the dataset and the first frame that most rows of `run` tell."""
    steps = np.arange(len(run))
    columns = run.columns
    recorded = columns[names.EPISODE_INDEX], columns[names.INDEX] - steps, columns[names.FRAME_INDEX] - steps
    number, first, frame = (int(np.sort(values)[len(run) // 2]) for values in recorded)
    return number, first, frame


def _lost(first: int, last: int) -> str:
    which = f"s {first} to {last}" if last > first else f" {first}"
    return f"left out episode{which}: rows that belong there cannot be read"


def _name(path: Path) -> str:
    """Return the path of a data file inside its dataset."""
    return "/".join(path.parts[-3:])


def _every_run(
    folder: Path, columns: Sequence[plain.PlainColumn], notes: list[str]
) -> Iterator[tuple[plain.Run, bool]]:
    """Yield each run, and whether the rows after it cannot be read."""
    for path in plain.data_files(folder):
        try:
            yield from _runs_of(path, columns, notes)
        except (*UNREADABLE, CorruptDatasetError) as error:
            notes.append(f"{_name(path)} cannot be read: {in_short(error)}")


def _runs_of(path: Path, columns: Sequence[plain.PlainColumn], notes: list[str]) -> Iterator[tuple[plain.Run, bool]]:
    """Yield the runs of a file, and whether the rows after each cannot be read."""
    is_whole = not isinstance(plain.read_footer(path), str)
    schema = pa.schema([(column.name, column.arrow_type) for column in columns])
    with pq.ParquetFile(path, metadata=None if is_whole else rebuilt_metadata(path, schema)) as file:
        counts = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
        if not is_whole:
            notes.append(f"{_name(path)} has no footer: {len(counts)} whole row groups were found in it")
        group = 0
        while group < len(counts):
            rows: list[int] = []
            faults: list[str] = []
            held: plain.Run | None = None
            first = sum(counts[:group])
            for run in plain.runs(path, _row_groups(file, columns, group, rows, faults), columns):
                if held is not None:
                    yield held, False
                held = replace(run, row=first + run.row)
            group += len(rows) + 1
            # LeRobot writes a row group per episode. With others, the last episode may be incomplete.
            if held is not None and not is_whole and group > len(counts) and len(held) != rows[-1]:
                part = f"the last {len(held)} frames in {path.name} may be part of an episode"
                notes.append(f"{part} and were left out")
            elif held is not None:
                yield held, bool(faults)
            if faults:
                lost = first + sum(rows)
                where = f"{_name(path)} rows {lost} to {lost + counts[group - 1] - 1}"
                notes.append(f"{where} cannot be read ({faults[0]})")


def _row_groups(
    file: pq.ParquetFile, columns: Sequence[plain.PlainColumn], first: int, rows: list[int], faults: list[str]
) -> Iterator[pa.Table]:
    """Yield row groups from `first` up to an unreadable one.

    Append their numbers of rows to `rows`, and what is wrong with the unreadable one to `faults`.
    """
    for group in range(first, file.num_row_groups):
        try:
            table = file.read_row_group(group, columns=[column.name for column in columns], use_threads=False)
            if not plain.schema_faults(table.schema, columns):
                plain.block_values(table, columns)
        except (*UNREADABLE, CorruptDatasetError) as error:
            faults.append(in_short(error))
            return
        rows.append(table.num_rows)
        yield table


class _Page(NamedTuple):
    """A page from byte `start` to `end`, header included; `unpacked` is its size without compression."""

    start: int
    end: int
    unpacked: int
    kind: int
    values: int
    encoding: int
    is_zstd: bool

    def fits(self, column: "_Leaf") -> bool:
        """Return whether it may belong to `column`: does the size match that of values of its width?"""
        if self.kind == _DICTIONARY or self.encoding not in _FIXED_WIDTH:
            return True
        least = self.values * column.bits // 8
        return least <= self.unpacked <= least + self.values // 2 + _HEADER


class _Leaf(NamedTuple):
    """A column: values per row and bits per value."""

    size: int
    bits: int


def rebuilt_metadata(path: Path, schema: pa.Schema) -> pq.FileMetaData:
    """Rebuild the metadata of the parquet file at `path`, which then reads with `ParquetFile(metadata=...)`.

    Returns:
        the metadata of all whole row groups.
    """
    leaves = [_leaf(field) for field in schema]
    pages = _pages(path)
    groups: list[list[list[_Page]]] = []
    first = 0
    while group := _row_group(pages, first, leaves):
        groups.append(group)
        first += sum(map(len, group))
    if not groups:
        raise CorruptDatasetError(f"{path.name} has no footer and no whole row group")
    template = io.BytesIO()
    row = pa.table([pa.nulls(1, field.type) for field in schema], schema=schema)
    pq.write_table(row, template, compression="snappy")
    footer = _footer(template.getvalue(), groups, leaves)
    file = b"PAR1" + footer + len(footer).to_bytes(4, "little") + b"PAR1"
    return pq.read_metadata(pa.BufferReader(file))


def _leaf(field: pa.Field) -> _Leaf:
    is_list = pa.types.is_fixed_size_list(field.type)
    value = field.type.value_type if is_list else field.type
    if not pa.types.is_primitive(value):
        raise CorruptDatasetError(f"column {field.name} ({field.type}) cannot be read without a footer")
    return _Leaf(field.type.list_size if is_list else 1, value.bit_width)


def _pages(path: Path) -> list[_Page]:
    pages: list[_Page] = []
    if not path.is_file():
        return pages
    with path.open("rb") as file:
        if file.read(4) != b"PAR1":
            return pages
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped, memoryview(mapped) as data:
            end = 4
            while page := _page(data, end):
                pages.append(page)
                end = page.end
    return pages


def _page(data: memoryview, start: int) -> _Page | None:
    """Read the header at `start`; None if there is none, or its page is not whole."""
    reader = _Reader(data, start)
    try:
        header = reader.struct()
        kind, unpacked, packed = (header[field][1] for field in (1, 2, 3))
        details = header[_DETAILS[kind]][1]
        values, encoding = details[1][1], details[_ENCODING[kind]][1]
        # In pages of the second kind, levels come first, and are not compressed.
        levels = sum(details[field][1] for field in (5, 6)) if kind == _DATA_V2 else 0
        body, end = reader.position + levels, reader.position + packed
        if min(unpacked, packed, values, encoding, levels) < 0 or end > len(data):
            return None
    except (IndexError, KeyError, RecursionError, TypeError, ValueError):
        return None
    size = unpacked + reader.position - start
    return _Page(start, end, size, kind, values, encoding, data[body : body + 4] == _ZSTD_MAGIC)


def _row_group(pages: Sequence[_Page], first: int, leaves: Sequence[_Leaf]) -> list[list[_Page]] | None:
    """Split the pages from `first` on into one chunk per column, of equally many rows; None if too few."""
    values = 0
    for number in range(first, len(pages)):
        if pages[number].kind == _DICTIONARY:
            if number > first:
                return None
            continue
        values += pages[number].values
        rows, rest = divmod(values, leaves[0].size)
        if not rest and (group := _chunks(pages, first, leaves, rows)):
            return group
    return None


def _chunks(pages: Sequence[_Page], position: int, leaves: Sequence[_Leaf], rows: int) -> list[list[_Page]] | None:
    chunks: list[list[_Page]] = []
    for leaf in leaves:
        chunk: list[_Page] = []
        missing = rows * leaf.size
        while missing > 0:
            if position == len(pages) or (chunk and pages[position].kind == _DICTIONARY):
                return None
            page = pages[position]
            if not page.fits(leaf):
                return None
            chunk.append(page)
            missing -= 0 if page.kind == _DICTIONARY else page.values
            position += 1
        if missing < 0:
            return None
        chunks.append(chunk)
    return chunks


def _footer(template: bytes, groups: list[list[list[_Page]]], leaves: Sequence[_Leaf]) -> bytes:
    """Return parquet's FileMetaData: the schema of `template`, a file of one row group, and `groups`."""
    length = int.from_bytes(template[-8:-4], "little")
    metadata = _Reader(template[-8 - length : -8]).struct()
    columns = [column[3][1] for column in metadata[4][1][1][0][1][1][1]]
    rows = [_values(group[0]) // leaves[0].size for group in groups]
    row_groups: list[Struct] = []
    for count, group in zip(rows, groups, strict=True):
        chunks = [_column_chunk(column, pages) for column, pages in zip(columns, group, strict=True)]
        size = sum(page.unpacked for pages in group for page in pages)
        row_groups.append({1: (LIST, (STRUCT, chunks)), 2: (I64, size), 3: (I64, count)})
    return _encoded(STRUCT, metadata | {3: (I64, sum(rows)), 4: (LIST, (STRUCT, row_groups))})


def _column_chunk(column: Struct, pages: Sequence[_Page]) -> Struct:
    """Return parquet's ColumnChunk of `pages`, with type and path of the template's `column`."""
    data = [page for page in pages if page.kind != _DICTIONARY]
    metadata: Struct = {
        1: column[1],
        2: (LIST, (I32, sorted({page.encoding for page in pages}))),
        3: column[3],
        4: (I32, _ZSTD if any(page.is_zstd for page in pages) else _SNAPPY),
        5: (I64, _values(pages)),
        6: (I64, sum(page.unpacked for page in pages)),
        7: (I64, pages[-1].end - pages[0].start),
        9: (I64, data[0].start),
    }
    if pages[0].kind == _DICTIONARY:
        metadata[11] = (I64, pages[0].start)
    return {2: (I64, pages[0].start), 3: (STRUCT, metadata)}


def _values(pages: Sequence[_Page]) -> int:
    return sum(page.values for page in pages if page.kind != _DICTIONARY)


class _Reader:
    """Reads structs of Thrift's compact protocol; IndexError or ValueError where there is none.

    A struct is a dict of field number to (type, value), a list is (type, values).
    """

    def __init__(self, data: bytes | memoryview, position: int = 0) -> None:
        self.data, self.position = data, position

    def struct(self) -> Struct:
        fields: Struct = {}
        number = 0
        while header := self._byte():
            kind = header & 15
            number = number + (header >> 4) if header >> 4 else self._signed()
            fields[number] = (kind, kind == TRUE if kind in (TRUE, FALSE) else self._value(kind))
        return fields

    def _value(self, kind: int) -> Any:  # noqa: ANN401 - any thrift value
        if kind in (TRUE, FALSE, BYTE):  # in a list, unlike in a struct, a truth value is a byte of its own
            return self._byte()
        if kind in (I16, I32, I64):
            return self._signed()
        if kind == BINARY:
            size = self._unsigned()
            self.position += size
            return bytes(self.data[self.position - size : self.position])
        if kind == LIST:
            header = self._byte()
            size = header >> 4 if header >> 4 < 15 else self._unsigned()
            return header & 15, [self._value(header & 15) for _ in range(size)]
        if kind == STRUCT:
            return self.struct()
        raise ValueError(f"thrift type {kind}")

    def _byte(self) -> int:
        self.position += 1
        return self.data[self.position - 1]

    def _unsigned(self) -> int:
        number = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            number |= (byte & 127) << shift
            if byte < 128:
                return number
        raise ValueError("a number does not end")

    def _signed(self) -> int:
        number = self._unsigned()
        return (number >> 1) ^ -(number & 1)


def _encoded(kind: int, value: Any) -> bytes:  # noqa: ANN401 - any thrift value
    """Return the bytes of a value as `_Reader` returns it."""
    if kind in (TRUE, FALSE, BYTE):
        return bytes([value])
    if kind in (I16, I32, I64):
        return _unsigned(value << 1 if value >= 0 else -value * 2 - 1)
    if kind == BINARY:
        return _unsigned(len(value)) + bytes(value)
    if kind == LIST:
        element, values = value
        length = b"" if len(values) < 15 else _unsigned(len(values))
        every = b"".join(_encoded(element, each) for each in values)
        return bytes([min(len(values), 15) << 4 | element]) + length + every
    out = b""
    for number, (inner, field) in sorted(value.items()):
        is_truth = inner in (TRUE, FALSE)
        out += bytes([(TRUE if field else FALSE) if is_truth else inner]) + _encoded(I16, number)
        out += b"" if is_truth else _encoded(inner, field)
    return out + b"\0"


def _unsigned(number: int) -> bytes:
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])
