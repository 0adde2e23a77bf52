"""NPZ: one array per field, rows along the first dimension. Read block by block; nothing is unpickled."""

from collections.abc import Iterator
from contextlib import ExitStack
from typing import IO, Any
from zipfile import ZipFile

import numpy as np
from numpy.lib import format as npy

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Array
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import BLOCK_ROWS, Block, Source, row_count

SUFFIXES = (".npz",)


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows, read from all arrays in parallel."""
    with source.open() as stream, ZipFile(stream) as archive, ExitStack() as exits:
        known = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
        source.refuse_beyond(
            sum(archive.getinfo(known[field]).file_size for field in mapping.all_fields if field in known)
        )
        files = {
            field: exits.enter_context(archive.open(known[field])) for field in mapping.all_fields if field in known
        }
        headers = {field: _header(file, source) for field, file in files.items()}
        shapes = {field: (0,) for field in known} | {field: shape for field, (shape, _) in headers.items()}
        n = row_count(str(source), mapping.all_fields, shapes)
        for first in range(0, n, BLOCK_ROWS):
            rows = min(BLOCK_ROWS, n - first)
            values = {
                field: _rows(files[field], (rows, *shape[1:]), dtype) for field, (shape, dtype) in headers.items()
            }
            yield Block(values, str(source), known=known)
        for file in files.values():
            if file.read(1):  # to the end, where the archive's sum is checked
                raise BadInputError(f"{source}: {file.name} holds more values than its header says")


def _header(file: IO[bytes], source: Source) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = npy.read_magic(file)  # type: ignore[no-untyped-call]
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, is_fortran, dtype = read_header(file)  # type: ignore[no-untyped-call]
    if dtype.hasobject:
        raise BadInputError(f"{source}: {file.name} holds Python objects, which are never unpickled")
    if is_fortran and len(shape) > 1:
        raise BadInputError(f"{file.name}: rows are not consecutive; save np.ascontiguousarray of it")
    return shape, dtype


def _rows(file: IO[bytes], shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
    size = int(np.prod(shape, dtype=object)) * dtype.itemsize
    content = file.read(size)
    if len(content) < size:
        raise BadInputError(f"{file.name}: ends early, {size - len(content)} bytes are missing")
    return np.frombuffer(content, dtype).reshape(shape)
