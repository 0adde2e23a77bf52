"""NPZ: one array per field, rows along the first dimension; nothing is unpickled."""

from collections.abc import Iterator
from io import BytesIO
from zipfile import ZipFile

from numpy.lib import format as npy

from astra_data.core.errors import BadInputError, in_short
from astra_data.dataset.columns import Array
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import Block, Source, row_count

SUFFIXES = (".npz",)


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows."""
    with source.open() as stream, ZipFile(stream) as archive:
        known = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
        used = [field for field in mapping.all_fields if field in known]
        source.refuse_beyond(sum(archive.getinfo(known[field]).file_size for field in used))
        values = {field: _array(archive, known[field], source) for field in used}
    shapes = dict.fromkeys(known, (0,)) | {field: array.shape for field, array in values.items()}
    if row_count(str(source), mapping.all_fields, shapes):
        yield Block(values, str(source), known=known)


def _array(archive: ZipFile, name: str, source: Source) -> Array:
    content = BytesIO(archive.read(name))
    try:
        values: Array = npy.read_array(content, allow_pickle=False)  # type: ignore[no-untyped-call]
    except ValueError as error:
        raise BadInputError(f"{source}: {name}: {in_short(error)}") from error
    if content.read(1):
        raise BadInputError(f"{source}: {name} holds more values than its header says")
    return values
