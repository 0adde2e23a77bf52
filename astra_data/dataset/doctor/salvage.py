"""Read the intact episodes of a damaged dataset, from files with or without a footer."""

import io
import mmap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.errors import CorruptDatasetError, in_short
from astra_data.dataset import columns as names
from astra_data.dataset import plain
from astra_data.dataset.description import Digests, alteration
from astra_data.dataset.format import IMAGE, INFO_PATH, UNREADABLE, arrow_type

_DICTIONARY, _DATA_V2 = 2, 3
_FIELDS = {0: (5, 2), _DICTIONARY: (7, 2), _DATA_V2: (8, 4)}
"""Of each kind of page, the field of its header with the details, and the field of these with the encoding."""
_FIXED_WIDTH = (0, 9)  # encodings PLAIN and BYTE_STREAM_SPLIT
_HEADER = 1000  # upper bound of a page header in bytes, including the extremes of its values
_SNAPPY, _ZSTD, _ZSTD_MAGIC = 1, 6, b"\x28\xb5\x2f\xfd"
_PIECES = 256  # of a row group that has rows which cannot be read
TRUE, FALSE, BYTE, I16, I32, I64 = range(1, 7)
BINARY, LIST, STRUCT = 8, 9, 12
Columns = Sequence[plain.PlainColumn]
Stretch = tuple[int, int, pa.Table | str]  # first row, end, and the table or what is wrong with it
Struct = dict[int, tuple[int, Any]]
"""Of Thrift's compact protocol: field number to (type, value); the value of a list is (type, values)."""


def whole_runs(
    folder: Path, columns: Columns, digests: Digests, fps: int, repeated: bool, notes: list[str]
) -> Iterator[tuple[int, plain.Run]]:
    """Yield the uid and the rows of each intact episode, repeated uids if asked; add to `notes` what was left out.

    An episode after rows that are lost is known by its own number and rows, where they agree with meta/episodes or,
    without that, where both are greater than those that should follow.
    """
    known = plain.read_object(folder / INFO_PATH)
    info = known if isinstance(known, dict) else {}
    places, faults = plain.read_places(folder, info)
    notes += [f"meta/episodes was rebuilt from the data: {fault}" for fault in faults]
    if not places and not faults:
        notes.append("meta/episodes was missing and was rebuilt from the data")
    notes += [f"{name} is missing" for name in plain.missing_files(folder, places)]
    counted = info.get("total_episodes")
    most = len(next(iter(digests.values()))) if digests else counted if isinstance(counted, int) else 2**31
    features = listed if isinstance(listed := info.get("features"), Mapping) else {}
    stored = {column.name: arrow_type(column.dtype, column.size) for column in columns}
    pictured = (name for name, of in features.items() if isinstance(of, Mapping) and of.get("dtype") == "image")
    stored = dict.fromkeys(pictured, IMAGE) | stored
    schema = pa.schema([(name, stored[name]) for name in dict.fromkeys([*features, *stored]) if name in stored])
    episode = row = 0
    uids: set[int] = set()
    for run, is_cut in _every_run(folder, columns, schema, notes):
        rows = f"rows {run.row} to {run.row + len(run) - 1} of {_name(run.path)}"
        # As most rows tell: the episode, its first row in the dataset and its first frame.
        steps, found = np.arange(len(run)), run.columns
        claimed = found[names.EPISODE_INDEX], found[names.INDEX] - steps, found[names.FRAME_INDEX] - steps
        number, first, frame = (int(np.sort(values)[len(run) // 2]) for values in claimed)
        place = places.get(number)
        if frame > 0 or (is_cut and (place is None or place.length != len(run))):
            if is_cut:
                notes.append(f"left out {rows}: they may be part of an episode")
            continue  # a part of an episode whose other rows are lost
        is_known = place is not None and place.length == len(run) and place.first_row in (None, first)
        if place is None and number < most:
            is_known = (number > episode and first > row) or (number < episode and first < row)
        if is_known and number < episode:
            notes.append(f"left out {rows}: they are of episode {number} once more")
            continue
        if is_known and number > episode:
            notes.append(_lost(episode, number - 1))
            episode, row = number, first
        faults = [fault for _, fault in plain.run_faults(run, number=episode, row=row, fps=fps)]
        altered = alteration(run.columns, episode, digests, run.path, run.row)
        if (place := places.get(episode)) and place.length != len(run) and (altered or episode >= most or not digests):
            faults.append(f"it has {len(run)} frames, expected {place.length}")
        if episode >= most and digests:
            faults.append(f"expected {most} episodes")
        faults += plain.flag_faults(run.columns, f"episode {episode} ")
        faults += [altered] if altered else []
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


def _lost(first: int, last: int) -> str:
    which = f"s {first} to {last}" if last > first else f" {first}"
    return f"left out episode{which}: rows that belong there cannot be read"


def _name(path: Path) -> str:
    return "/".join(path.parts[-3:])


def _every_run(root: Path, columns: Columns, schema: pa.Schema, notes: list[str]) -> Iterator[tuple[plain.Run, bool]]:
    """Yield each run, and whether the rows after it cannot be read."""
    for path in plain.data_files(root):
        try:
            yield from _runs_of(path, columns, schema, notes)
        except (*UNREADABLE, CorruptDatasetError) as error:
            notes.append(f"{_name(path)} cannot be read: {in_short(error)}")


def _runs_of(path: Path, columns: Columns, schema: pa.Schema, notes: list[str]) -> Iterator[tuple[plain.Run, bool]]:
    """Yield the runs of a file, and whether the rows after each cannot be read."""
    is_whole = not isinstance(plain.read_footer(path), str)
    held: plain.Run | None = None
    with pq.ParquetFile(path, metadata=None if is_whole else rebuilt_metadata(path, schema)) as file:
        last = file.metadata.row_group(file.num_row_groups - 1).num_rows if file.num_row_groups else 0
        if not is_whole:
            notes.append(f"{_name(path)} has no footer: {file.num_row_groups} whole row groups were found in it")
        for is_read, stretch in groupby(_stretches(file, columns), lambda one: isinstance(one[2], pa.Table)):
            if is_read:
                first, _, table = next(stretch)
                for run in plain.runs(path, chain([table], (one for _, _, one in stretch)), columns):
                    if held is not None:
                        yield held, False
                    held = replace(run, row=first + run.row)
                continue
            if held is not None:
                yield held, True
            held, lost = None, list(stretch)
            rows = f"rows {lost[0][0]} to {lost[-1][1] - 1}"
            notes.append(f"{_name(path)} {rows} cannot be read ({lost[0][2]})")
    if held is not None:  # LeRobot writes a row group per episode; with others, the last may be incomplete
        yield held, not is_whole and len(held) != last


def _stretches(file: pq.ParquetFile, columns: Columns) -> Iterator[Stretch]:
    """Yield first row, end and table of stretches of a file, or what is wrong with them."""
    first = 0
    for group in range(file.num_row_groups):
        end = first + file.metadata.row_group(group).num_rows
        try:
            table = file.read_row_group(group, columns=[column.name for column in columns], use_threads=False)
            yield from _readable(first, table, columns, max(1, len(table) // _PIECES))
        except (*UNREADABLE, CorruptDatasetError) as error:
            yield first, end, in_short(error)
        first = end


def _readable(first: int, table: pa.Table, columns: Columns, least: int) -> Iterator[Stretch]:
    """Yield a table, from the row `first` on, or its halves, of `least` rows, where a value of it cannot be read."""
    try:
        if not plain.schema_faults(table.schema, columns):
            plain.block_values(table, columns)
    except CorruptDatasetError as error:
        if len(table) <= least:
            yield first, first + len(table), in_short(error)
            return
        half = len(table) // 2
        yield from _readable(first, table[:half], columns, least)
        yield from _readable(first + half, table[half:], columns, least)
    else:
        yield first, first + len(table), table


class _Page(NamedTuple):
    """A page from byte `start` to `end`, header included; `unpacked` is its size without compression."""

    start: int
    end: int
    unpacked: int
    kind: int
    values: int  # 0 of a dictionary
    encoding: int
    is_zstd: bool


def _may_hold(page: _Page, bits: int) -> bool:
    """Return whether `page` may be of values of so many bits: does its size match?"""
    least = page.values * bits // 8
    is_fixed = bits and page.kind != _DICTIONARY and page.encoding in _FIXED_WIDTH
    return not is_fixed or least <= page.unpacked <= least + page.values // 2 + _HEADER


def rebuilt_metadata(path: Path, schema: pa.Schema) -> pq.FileMetaData:
    """Return the metadata of all whole row groups of the parquet file at `path`, for `ParquetFile(metadata=...)`."""
    leaves: list[tuple[int, int]] = []  # values per row, and bits per value, 0 where these differ
    for field in schema:
        if field.type == IMAGE:
            leaves += [(1, 0)] * IMAGE.num_fields
            continue
        is_list = pa.types.is_fixed_size_list(field.type)
        value = field.type.value_type if is_list else field.type
        if not pa.types.is_primitive(value):
            raise CorruptDatasetError(f"column {field.name} ({field.type}) cannot be read without a footer")
        leaves.append((field.type.list_size if is_list else 1, value.bit_width))
    pages, groups, first = list(_pages(path)), list[list[list[_Page]]](), 0
    while group := _row_group(pages, first, leaves):
        groups.append(group)
        first += sum(map(len, group))
    if not groups:
        raise CorruptDatasetError(f"{path.name} has no footer and no whole row group")
    template = io.BytesIO()
    row = pa.table([pa.nulls(1, field.type) for field in schema], schema=schema)
    pq.write_table(row, template, compression="snappy")
    footer = _footer(template.getvalue(), groups, leaves)
    return pq.read_metadata(pa.BufferReader(b"PAR1" + footer + len(footer).to_bytes(4, "little") + b"PAR1"))


def _pages(path: Path) -> Iterator[_Page]:
    if not path.is_file():
        return
    with path.open("rb") as file:
        if file.read(4) == b"PAR1":
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped, memoryview(mapped) as data:
                end = 4
                while page := _page(data, end):
                    yield page
                    end = page.end


def _page(data: memoryview, start: int) -> _Page | None:
    """Read the header at `start`; None if there is none, or its page is not whole."""
    try:
        header, body = _decoded(data, start)
        kind, unpacked, packed = (header[field][1] for field in (1, 2, 3))
        details_field, encoding_field = _FIELDS[kind]
        details = header[details_field][1]
        values, encoding = details[1][1], details[encoding_field][1]
        # In pages of the second kind, levels come first, and are not compressed.
        levels = sum(details[field][1] for field in (5, 6)) if kind == _DATA_V2 else 0
    except (IndexError, KeyError, RecursionError, TypeError, ValueError):
        return None
    if min(unpacked, packed, values, encoding, levels) < 0 or body + packed > len(data):
        return None
    is_zstd = data[body + levels : body + levels + 4] == _ZSTD_MAGIC
    values = 0 if kind == _DICTIONARY else values
    return _Page(start, body + packed, unpacked + body - start, kind, values, encoding, is_zstd)


def _row_group(pages: Sequence[_Page], first: int, leaves: Sequence[tuple[int, int]]) -> list[list[_Page]] | None:
    """Split the pages from `first` on into one chunk per column, of equally many rows; None if too few."""
    values = 0
    for number in range(first, len(pages)):
        if pages[number].kind == _DICTIONARY and number > first:
            return None
        values += pages[number].values
        rows, rest = divmod(values, leaves[0][0])
        if rows and not rest and (group := _chunks(pages, first, leaves, rows)):
            return group
    return None


def _chunks(
    pages: Sequence[_Page], position: int, leaves: Sequence[tuple[int, int]], rows: int
) -> list[list[_Page]] | None:
    chunks: list[list[_Page]] = []
    for size, bits in leaves:
        first, missing = position, rows * size
        while missing > 0:
            is_next = position > first and position < len(pages) and pages[position].kind == _DICTIONARY
            if position == len(pages) or is_next or not _may_hold(pages[position], bits):
                return None
            missing -= pages[position].values
            position += 1
        if missing < 0:
            return None
        chunks.append(list(pages[first:position]))
    return chunks


def _footer(template: bytes, groups: list[list[list[_Page]]], leaves: Sequence[tuple[int, int]]) -> bytes:
    """Return parquet's FileMetaData: the schema of `template`, a file of one row group, and `groups`."""
    length = int.from_bytes(template[-8:-4], "little")
    metadata = _decoded(template[-8 - length : -8], 0)[0]
    columns = [column[3][1] for column in metadata[4][1][1][0][1][1][1]]
    rows = [sum(page.values for page in group[0]) // leaves[0][0] for group in groups]
    row_groups: list[Struct] = []
    for count, group in zip(rows, groups, strict=True):
        chunks = [_column_chunk(column, pages) for column, pages in zip(columns, group, strict=True)]
        size = sum(page.unpacked for pages in group for page in pages)
        row_groups.append({1: (LIST, (STRUCT, chunks)), 2: (I64, size), 3: (I64, count)})
    return _encoded(STRUCT, metadata | {3: (I64, sum(rows)), 4: (LIST, (STRUCT, row_groups))})


def _column_chunk(column: Struct, pages: Sequence[_Page]) -> Struct:
    """Return parquet's ColumnChunk of `pages`, with type and path of the template's `column`."""
    first = pages[0]
    metadata: Struct = {
        1: column[1],
        2: (LIST, (I32, sorted({page.encoding for page in pages}))),
        3: column[3],
        4: (I32, _ZSTD if any(page.is_zstd for page in pages) else _SNAPPY),
        5: (I64, sum(page.values for page in pages)),
        6: (I64, sum(page.unpacked for page in pages)),
        7: (I64, pages[-1].end - first.start),
        9: (I64, next(page.start for page in pages if page.kind != _DICTIONARY)),
    }
    if first.kind == _DICTIONARY:
        metadata[11] = (I64, first.start)
    return {2: (I64, first.start), 3: (STRUCT, metadata)}


def _decoded(data: bytes | memoryview, position: int) -> tuple[Struct, int]:
    """Read the struct at `position`, and return where it ends; IndexError or ValueError where there is none."""

    def byte() -> int:
        nonlocal position
        position += 1
        return data[position - 1]

    def unsigned() -> int:
        number = 0
        for shift in range(0, 70, 7):
            part = byte()
            number |= (part & 127) << shift
            if part < 128:
                return number
        raise ValueError("a number does not end")

    def signed() -> int:
        number = unsigned()
        return (number >> 1) ^ -(number & 1)

    def value(kind: int) -> Any:  # noqa: ANN401 - any thrift value
        nonlocal position
        if kind in (TRUE, FALSE, BYTE):  # in a list, unlike in a struct, a truth value is a byte of its own
            return byte()
        if kind in (I16, I32, I64):
            return signed()
        if kind == BINARY:
            size = unsigned()
            position += size
            return bytes(data[position - size : position])
        if kind == LIST:
            header = byte()
            size = header >> 4 if header >> 4 < 15 else unsigned()
            return header & 15, [value(header & 15) for _ in range(size)]
        if kind == STRUCT:
            return struct()
        raise ValueError(f"thrift type {kind}")

    def struct() -> Struct:
        fields, number = Struct(), 0
        while header := byte():
            kind = header & 15
            number = number + (header >> 4) if header >> 4 else signed()
            fields[number] = (kind, kind == TRUE if kind in (TRUE, FALSE) else value(kind))
        return fields

    return struct(), position


def _encoded(kind: int, value: Any) -> bytes:  # noqa: ANN401 - any thrift value
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
    return bytes([number & 127 | 128]) + _unsigned(number >> 7) if number > 127 else bytes([number])
