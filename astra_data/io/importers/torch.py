"""PyTorch: a dictionary of tensors, rows along the first dimension, as `torch.save` writes it.

Only tensors are taken, through PyTorch's own restricted reader: nothing of the file is run.
"""

from collections.abc import Iterator
from pickle import UnpicklingError
from zipfile import ZipFile, is_zipfile

from astra_data.core.errors import BadInputError, optional
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import VALUE_BYTES, Block, Source, row_count

SUFFIXES = (".pt", ".pth")


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows of the tensors of the dictionary in the file; what else it holds is left out."""
    torch = optional("torch")
    if not is_zipfile(source.path):
        raise BadInputError(f"{source}: expected a file that torch.save wrote")
    with ZipFile(source.path) as archive:
        source.refuse_beyond(sum(entry.file_size for entry in archive.infolist()))
    try:
        found = torch.load(source.path, map_location="cpu", weights_only=True)
    except UnpicklingError as error:
        fault = "holds Python objects, which are never unpickled, or is damaged"
        raise BadInputError(f"{source}: {fault}; save a dictionary of tensors alone") from error
    if not isinstance(found, dict):
        raise BadInputError(f"{source}: expected a dictionary of tensors, got {type(found).__name__}")
    tensors = {
        name: value.detach()
        for name, value in found.items()
        if isinstance(name, str) and isinstance(value, torch.Tensor) and value.layout == torch.strided
    }
    n = row_count(str(source), mapping.all_fields, {name: value.shape for name, value in tensors.items()})
    used = {field: tensors[field] for field in mapping.all_fields}
    source.refuse_beyond(sum(VALUE_BYTES * value.numel() for value in used.values()))
    if n:
        yield Block({name: value.numpy() for name, value in used.items()}, str(source), known=tensors)
