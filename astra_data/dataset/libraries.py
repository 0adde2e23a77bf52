"""The files of a dataset as the objects of other libraries."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.optional import optional
from astra_data.dataset.plain import data_files

if TYPE_CHECKING:
    import datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset


def to_huggingface(root: Path) -> "datasets.Dataset":
    """Return the rows as a `datasets.Dataset` in memory, with the features that lerobot gives them.

    It is read from the same files, and nothing is written.

    Raises:
        BadInputError: datasets is not installed.
    """
    library = optional("datasets")
    rows: datasets.Dataset = library.Dataset(pa.concat_tables(map(pq.read_table, data_files(root))))
    return rows


def to_lerobot(root: Path, name: str, **options: Any) -> "LeRobotDataset":  # noqa: ANN401 - lerobot's own
    """Return lerobot's own object over the same files; lerobot keeps a copy of the rows in its cache.

    Args:
        root: the dataset's folder.
        name: that lerobot shows.
        options: of `LeRobotDataset`, such as `delta_timestamps`.

    Raises:
        BadInputError: lerobot is not installed.
    """
    library = optional("lerobot.datasets.lerobot_dataset")
    opened: LeRobotDataset = library.LeRobotDataset(f"local/{name}", root=root, **options)
    return opened
