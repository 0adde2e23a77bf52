"""Rebuild the footer of parquet files whose writer was killed, from the headers of their pages.

A file is "PAR1", then the row groups: for each column its pages, an optional dictionary page first; each page
follows a header with its size and number of values. Where a column ends is not stored in the headers; it is
inferred, because all columns of a row group have the same number of rows.
"""

import io
import mmap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.doctor.thrift import I32, I64, LIST, STRUCT, Reader, Struct, encode

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


@dataclass(frozen=True)
class _Page:
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


@dataclass(frozen=True)
class _Leaf:
    """A column: values per row and bits per value."""

    size: int
    bits: int


def rebuilt_metadata(path: Path, schema: pa.Schema) -> pq.FileMetaData:
    """Rebuild the metadata of the parquet file at `path`, which then reads with `ParquetFile(metadata=...)`.

    Args:
        path: a file without footer, compressed with snappy or zstd.
        schema: its columns, numbers or lists of fixed size, none of them null.

    Returns:
        the metadata of all whole row groups.

    Raises:
        CorruptDatasetError: there is no whole row group, or a column is of another kind.
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
    reader = Reader(data, start)
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


def _chunks(
    pages: Sequence[_Page], position: int, leaves: Sequence[_Leaf], rows: int
) -> list[list[_Page]] | None:
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
    metadata = Reader(template[-8 - length : -8]).struct()
    columns = [column[3][1] for column in metadata[4][1][1][0][1][1][1]]
    rows = [_values(group[0]) // leaves[0].size for group in groups]
    row_groups: list[Struct] = []
    for count, group in zip(rows, groups, strict=True):
        chunks = [_column_chunk(column, pages) for column, pages in zip(columns, group, strict=True)]
        size = sum(page.unpacked for pages in group for page in pages)
        row_groups.append({1: (LIST, (STRUCT, chunks)), 2: (I64, size), 3: (I64, count)})
    return encode(metadata | {3: (I64, sum(rows)), 4: (LIST, (STRUCT, row_groups))})


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
