"""HDF5 files that are written whole, or not at all.

HDF5 loses a failure that it meets while it closes a file, and the process ends in a segmentation fault. So it
writes through an object that never fails: the first error is kept, and raised once HDF5 is done.
"""

import io
from collections.abc import Buffer, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from astra_data.core.optional import optional


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
