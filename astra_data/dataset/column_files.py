"""Columns too large for memory, as memory-mapped raw files."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from astra_data.core.errors import CorruptDatasetError
from astra_data.core.lock import held
from astra_data.dataset.atomic import atomic_folder
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.reader import Dataset


def cache_folder() -> Path:
    """Return the folder of the raw files: $ASTRA_DATA_CACHE, by default ~/.cache/astra-data."""
    return Path(os.environ.get("ASTRA_DATA_CACHE", Path.home() / ".cache" / "astra-data"))


def mapped_columns(dataset: Dataset, names: Sequence[str], cache: Path) -> dict[str, Array]:
    """Memory-map whole columns, (N, size) or (N,), from raw files in `cache`; missing files are written.

    The files are <cache>/<content hash>/<column>/values.npy. Changes of the arrays stay in this process. One
    process at a time writes a dataset's files; the others wait.

    Raises:
        BadInputError: a column does not exist.
        CorruptDatasetError: the dataset or a raw file cannot be read.
    """
    specs = dataset.specs(names)
    parent = cache / dataset.content_hash
    parent.mkdir(parents=True, exist_ok=True)
    with held(parent, wait=True):
        for column in specs:
            folder = parent / column.name
            if not folder.exists():
                _write(dataset, column, folder)
    columns: dict[str, Array] = {}
    for name in names:
        folder = parent / name
        try:
            columns[name] = np.load(folder / "values.npy", mmap_mode="c")
        except (OSError, ValueError) as error:
            raise CorruptDatasetError(f"{folder} was altered ({error}); delete it and try again.") from error
    for name in dataset.altered(columns):
        raise CorruptDatasetError(f"{parent / name} was altered (other values); delete it and try again.")
    return columns


def _write(dataset: Dataset, column: Column, folder: Path) -> None:
    shape = (int(dataset.lengths.sum()), column.size)[: 1 + (column.size > 1)]
    header = {"descr": np.dtype(column.dtype).str, "fortran_order": False, "shape": shape}
    # Not as a memory map: where the disk is full, that would end the process with a bus error.
    with atomic_folder(folder) as unfinished, (unfinished / "values.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)  # type: ignore[no-untyped-call]
        for block in dataset.blocks([column.name]):
            file.write(block[column.name].data)
