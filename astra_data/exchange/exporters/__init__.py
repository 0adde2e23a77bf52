"""Export of datasets to the formats of other libraries, one file per format.

All exporters stream episode by episode, write atomically and never overwrite.
"""

from collections.abc import Callable
from pathlib import Path

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED
from astra_data.dataset.reader import Dataset
from astra_data.exchange.exporters import d3rlpy, d4rl, minari, robomimic

EXPORTERS: dict[str, Callable[[Dataset, Path], None]] = {
    "d3rlpy": d3rlpy.export,
    "d4rl": d4rl.export,
    "minari": minari.export,
    "robomimic": robomimic.export,
}

NEEDED = (STATE, ACTION, REWARD, TERMINATED, TRUNCATED, NEXT_STATE)
"""Columns that every format needs."""


def export(dataset: Dataset, out: Path, *, format: str) -> None:
    """Write `dataset` to `out` in the layout of the library `format`.

    Raises:
        BadInputError: the format is unknown, a column or a package that it needs is missing, or `out` exists.
    """
    if format not in EXPORTERS:
        raise BadInputError(f"format '{format}': unknown{did_you_mean(format, EXPORTERS)}")
    missing = [name for name in NEEDED if name not in dataset.features]
    if missing:
        raise BadInputError(f"{dataset.reference} cannot be exported: it lacks {', '.join(missing)}")
    EXPORTERS[format](dataset, out)
