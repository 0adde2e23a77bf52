"""HDF5 files: written whole or not at all, and what those of others really hold.

A file by a stranger may point elsewhere, or claim more than there is. HDF5 loses a failure that it meets
while it closes a file, and the process ends in a segmentation fault. So it writes through an object that
never fails: the first error is kept, and raised once HDF5 is done.
"""

import io
from collections.abc import Buffer, Iterable, Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.core.optional import optional

MOST_COMPRESSED = 10_000
"""Larger than the compression ratio of any filter; beyond it, the values were never written."""


class Disk(io.RawIOBase):
    """A new file that keeps the first error of writing instead of raising it.

    Attributes:
        failure: that error; None while all is well.
    """

    def __init__(self, path: Path) -> None:
        """Create the file at `path`.

        Raises:
            OSError: it cannot be created.
        """
        self.failure: OSError | None = None
        self._file = path.open("w+b", buffering=0)

    def until_it_fails[T](self, items: Iterable[T]) -> Iterator[T]:
        """Yield `items` as long as everything could be written.

        Raises:
            OSError: the first error.
        """
        for item in items:
            yield item
            self.check()

    def check(self) -> None:
        """Raise the first error, if there was one."""
        if self.failure:
            raise self.failure

    def readinto(self, buffer: Buffer, /) -> int:
        """Read into `buffer`."""
        return self._file.readinto(buffer)

    def write(self, content: Buffer, /) -> int:
        """Write all of `content`, as far as the disk takes it."""
        rest = memoryview(content).cast("B")
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self.failure = self.failure or error
        return memoryview(content).nbytes

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Move to `offset`."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Return where the next byte is read or written."""
        return self._file.tell()

    def truncate(self, size: int | None = None, /) -> int:
        """Cut or extend the file."""
        try:
            return self._file.truncate(size)
        except OSError as error:
            self.failure = self.failure or error
            return size or 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


@contextmanager
def hdf5_file(path: Path, *, track_order: bool = False) -> Iterator[tuple[Any, Disk]]:
    """Yield a new HDF5 file at `path`, and the disk that it is written to.

    Args:
        path: must not exist yet.
        track_order: list groups in the order of their making instead of by name.

    Raises:
        BadInputError: h5py is not installed.
        OSError: something could not be written; what there is at `path` is of no use.
    """
    h5py = optional("h5py")
    disk = Disk(path)
    try:
        with h5py.File(disk, "w", track_order=track_order) as file:
            yield file, disk
    except Exception:
        # What HDF5 stumbles over after a failed write is not the reason.
        disk.check()
        raise
    finally:
        disk.close()
    disk.check()


def stored_datasets(h5py: Any, group: Any) -> dict[str, Any]:  # noqa: ANN401 - of h5py
    """Map the path of each dataset below `group` to it; links into other files are not followed."""
    found: dict[str, Any] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = item

    group.visititems(visit)
    return found


def refuse_links(h5py: Any, file: Any, origin: str) -> None:  # noqa: ANN401 - of h5py
    """Refuse a file with links, which may lead into other files.

    Raises:
        BadInputError: it has links; lists them.
    """
    links: list[str] = []

    def visit(name: str, link: object) -> None:
        if not isinstance(link, h5py.HardLink):
            links.append(name)

    file.visititems_links(visit)
    if links:
        raise BadInputError(
            f"{origin}: {', '.join(links[:10])}: expected no links; replace each by a copy of its target"
        )


def check_storage(datasets: Mapping[str, Any], origin: str) -> None:
    """Check that all `datasets` are in their own file, as large as they claim, and written as a whole.

    Raises:
        BadInputError: one is not; lists every fault.
    """
    faults = []
    for field, dataset in datasets.items():
        if dataset.external or dataset.is_virtual:
            faults.append(f"field '{field}' lies in another file; copy it into this one")
        elif dataset.nbytes > MOST_COMPRESSED * (dataset.id.get_storage_size() + 2**10):
            faults.append(f"field '{field}' claims the shape {dataset.shape}, but the file does not hold it")
        elif not _is_written(dataset):
            faults.append(f"field '{field}' was not written as a whole: what is missing reads as 0")
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")


def _is_written(dataset: Any) -> bool:  # noqa: ANN401 - of h5py
    """Return whether all values are in the file; others would be read as the fill value."""
    if dataset.chunks is None:
        return bool(dataset.size == 0 or dataset.id.get_storage_size() > 0)
    wanted = prod(-(-length // chunk) for length, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    return bool(dataset.id.get_num_chunks() >= wanted)


def unpacked_bytes(datasets: Mapping[str, Any]) -> int:
    """Return how many bytes are read with all `datasets`; a chunk is unpacked whole, however few its rows."""
    chunks = {name: int(np.prod(d.chunks or (0,), dtype=object)) for name, d in datasets.items()}
    return sum(max(int(d.nbytes), chunks[name] * d.dtype.itemsize) for name, d in datasets.items())
