"""Export of datasets to the formats of other libraries, one file per format.

All exporters stream episode by episode, write atomically and never overwrite. What they wrote is read again
and compared with the dataset before it is shown.
"""

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from astra_data.core.config import did_you_mean
from astra_data.core.durable import atomic_file, atomic_folder
from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset.columns import ACTION, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED
from astra_data.dataset.reader import Dataset
from astra_data.io.export_record import read_record, restored
from astra_data.io.exporters import d3rlpy, d4rl, minari, robomimic
from astra_data.io.importers import hdf5
from astra_data.io.importers import minari as minari_importer
from astra_data.io.recording import Source


class Exporter(NamedTuple):
    """A format: what writes it, where to, and what reads it."""

    write: Callable[[Dataset, Path, Path], None]
    place: Callable[[Path], AbstractContextManager[Path]]
    importer: ModuleType


EXPORTERS = {
    "d3rlpy": Exporter(d3rlpy.write, atomic_file, hdf5),
    "d4rl": Exporter(d4rl.write, atomic_file, hdf5),
    "minari": Exporter(minari.write, atomic_folder, minari_importer),
    "robomimic": Exporter(robomimic.write, atomic_file, hdf5),
}

NEEDED = (STATE, ACTION, TERMINATED, TRUNCATED, NEXT_STATE)
"""Columns that every format needs."""

_log = logging.getLogger(__name__)


def export(dataset: Dataset, out: Path, *, format: str) -> None:
    """Write `dataset` to `out` in the layout of the library `format`; rewards are 0 where it has none.

    Raises:
        BadInputError: the format is unknown, a column or a package that it needs is missing, or `out` exists.
        DiskError: `out` cannot be written; nothing is left of it.
        CorruptDatasetError: what was written does not read as the dataset does.
    """
    if format not in EXPORTERS:
        raise BadInputError(f"format '{format}': unknown{did_you_mean(format, EXPORTERS)}")
    missing = [name for name in NEEDED if name not in dataset.features]
    if missing:
        raise BadInputError(f"{dataset.reference} cannot be exported: it lacks {', '.join(missing)}")
    if REWARD not in dataset.features:
        _log.warning("%s has no %s: rewards are written as 0", dataset.reference, REWARD)
    exporter = EXPORTERS[format]
    with exporter.place(out) as path:
        exporter.write(dataset, path, out)
        _compare(exporter.importer, path, out)


def _compare(importer: ModuleType, path: Path, out: Path) -> None:
    """Read what was written at `path`, and compare its sums."""
    source = Source(path, None, path)
    try:
        record = read_record(importer, source)
        if record is None:
            raise CorruptDatasetError("it has no record of the export")
        for _ in restored(importer, source, record):
            pass
    except (CorruptDatasetError, BadInputError) as error:
        raise CorruptDatasetError(f"{out} was not written: {error}. Check the disk.") from error
