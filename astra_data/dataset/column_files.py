"""Columns too large for memory: raw files that the operating system maps in, page by page."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from astra_data.core.errors import CorruptDatasetError
from astra_data.core.lock import held
from astra_data.dataset.atomic import atomic_folder
from astra_data.dataset.columns import Array
from astra_data.dataset.reader import Dataset

MEMORY_LIMIT = Path("/sys/fs/cgroup/memory.max")
"""Bytes that the processes of a container may take, or "max"; absent outside of one."""


def cache_folder() -> Path:
    """Return where the raw files live: $ASTRA_DATA_CACHE, by default ~/.cache/astra-data."""
    return Path(os.environ.get("ASTRA_DATA_CACHE", Path.home() / ".cache" / "astra-data"))


def memory_bytes() -> int:
    """Return the size of this machine's memory, or of the share of it that a container has."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limit = MEMORY_LIMIT.read_text().strip() if MEMORY_LIMIT.exists() else "max"
    return machine if limit == "max" else min(machine, int(limit))


def mapped_columns(dataset: Dataset, names: Sequence[str], cache: Path) -> dict[str, Array]:
    """Map whole columns, (N, size) or (N,), from raw files in `cache`, which are written where missing.

    <cache>/<content hash>/<column>/values.npy; what is written to the arrays stays in this process. One
    process at a time writes a dataset's files, and the others wait for them.

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
                shape = (int(dataset.lengths.sum()), *([column.size] if column.size > 1 else []))
                _write(dataset, column.name, column.dtype, shape, folder)
    columns: dict[str, Array] = {}
    for name in names:
        folder = parent / name
        try:
            columns[name] = np.load(folder / "values.npy", mmap_mode="c")
        except (OSError, ValueError) as error:
            raise CorruptDatasetError(f"{folder} was altered ({error}); delete it and try again.") from error
    return columns


def _write(dataset: Dataset, name: str, dtype: str, shape: tuple[int, ...], folder: Path) -> None:
    with atomic_folder(folder) as unfinished:
        path = unfinished / "values.npy"
        values = np.lib.format.open_memmap(  # type: ignore[no-untyped-call]
            path, mode="w+", dtype=np.dtype(dtype), shape=shape
        )
        row = 0
        for block in dataset.blocks([name]):
            values[row : row + len(block[name])] = block[name]
            row += len(block[name])
        values.flush()
