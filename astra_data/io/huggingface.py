"""A table of the library `datasets` as a dataset."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from astra_data.dataset.reader import Dataset
from astra_data.io.importing import import_dataset

if TYPE_CHECKING:
    import datasets


def from_huggingface(table: "datasets.Dataset", mapping: Path | str, *, out: Path | None = None) -> Dataset:
    """Import the rows of a `datasets.Dataset`, as `import` does those of a Parquet file.

    Args:
        table: the rows, in the order of time; `[split] field = "episode_index"` of the mapping cuts them.
        mapping: the file that says which columns become which.
        out: the dataset's folder, by default its place at home.

    Raises:
        BadInputError: the rows do not fit the mapping; nothing is written.
        RecipeError: the mapping has faults.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rows.parquet"
        table.to_parquet(path)
        return Dataset.open(import_dataset([path], Path(mapping), out=out).root)
