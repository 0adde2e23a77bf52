from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from damaged import edit, reseal, truncate

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset import Dataset
from astra_data.dataset.format import DATASET_PATH


def drop_rows(root: Path) -> None:
    path = root / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(path).slice(0, 50).drop_columns(["action"]), path)


def forged(**changes: object) -> Callable[[Path], None]:
    """Change meta/info.json and the sums of it."""

    def damage(root: Path) -> None:
        edit("meta/info.json", **changes)(root)
        reseal(root)

    return damage


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (truncate("data/chunk-000/file-000.parquet"), ["file-000.parquet is truncated"]),
        (truncate("meta/info.json"), ["meta/info.json was altered"]),
        (lambda root: (root / "meta/stats.json").unlink(), ["meta/stats.json missing"]),
        (lambda root: (root / DATASET_PATH).unlink(), ["dataset.json is missing"]),
        (drop_rows, ["has 50 rows, expected 55", "lacks column action"]),
        # A description may be forged.
        (forged(fps=0, data_path="../{file_index}.parquet"), ["a path inside the dataset's folder"]),
        (forged(features={"action": 3}), ["its metadata are not those of a dataset"]),
    ],
)
def test_damage_is_told_in_one_line(root: Path, damage: Callable[[Path], object], parts: list[str]) -> None:
    damage(root)
    with pytest.raises(CorruptDatasetError) as caught:
        Dataset.open(root)
    message = str(caught.value)
    assert message.startswith(f"{root} is incomplete or was altered: ")
    repair = f"`astra-data repair {root} --out FOLDER`, with `--like ORIGINAL` if LeRobot's tools edited it."
    assert message.endswith(f"or recover its intact episodes: {repair}") and "\n" not in message
    for part in parts:
        assert part in message
