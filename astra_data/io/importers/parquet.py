"""Parquet: a column per field, of numbers or of lists that are equally long."""

from collections.abc import Iterator
from contextlib import suppress

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Array
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import VALUE_BYTES, Block, Source, row_count

SUFFIXES = (".parquet",)


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows of the fields; missing numbers are NaN, and times whole numbers of their own unit."""
    fields = mapping.all_fields
    with source.open() as stream, pq.ParquetFile(stream) as file:
        shapes = dict.fromkeys(file.schema_arrow.names, (file.metadata.num_rows,))
        row_count(str(source), fields, shapes)
        groups = [file.metadata.row_group(number) for number in range(file.num_row_groups)]
        chunks = [group.column(number) for group in groups for number in range(file.metadata.num_columns)]
        paths = tuple(f"{field}." for field in fields)  # compressed zeros take hardly any bytes: values are counted
        held = sum(chunk.num_values for chunk in chunks if f"{chunk.path_in_schema}.".startswith(paths))
        source.refuse_beyond(VALUE_BYTES * held)
        table = file.read(fields)
    if table.num_rows:
        values = {field: _array(table.column(field).combine_chunks(), f"{source}: field '{field}'") for field in fields}
        yield Block(values, str(source), known=file.schema_arrow.names)


def _array(column: pa.Array, origin: str) -> Array:
    """Return the rows as (n,), or (n, ...) where each is a list; text stays text."""
    kind = column.type
    if pa.types.is_dictionary(kind):
        return _array(column.dictionary_decode(), origin)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        flat = column.flatten()
        is_fixed = pa.types.is_fixed_size_list(kind)
        sizes = {kind.list_size} if is_fixed else set(column.value_lengths().to_pylist())
        if column.null_count or len(sizes) > 1:
            raise BadInputError(f"{origin}: expected lists of one length, without missing ones")
        size = sizes.pop()
        values = _array(flat, origin) if len(flat) else np.empty(0)
        return values.reshape(len(column), size, *values.shape[1:])
    if pa.types.is_temporal(kind):
        return _array(column.cast(pa.int32() if kind.bit_width == 32 else pa.int64()), origin)
    if pa.types.is_decimal(kind):
        return _array(column.cast(pa.float64()), origin)
    if column.null_count and (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
        with suppress(pa.ArrowInvalid):  # of integers that no float64 is
            column = (column.cast(pa.float64()) if pa.types.is_integer(kind) else column).fill_null(float("nan"))
    if column.null_count:
        raise BadInputError(f"{origin}: {column.null_count} values are missing, and {kind} has no NaN")
    if pa.types.is_boolean(kind):
        return _array(column.cast(pa.uint8()), origin).astype(bool)
    if pa.types.is_integer(kind) or pa.types.is_floating(kind):
        return np.from_dlpack(column)
    return np.array(column.to_pylist(), dtype=str)
