"""Damage for datasets in tests: each function returns a change of the dataset in a folder."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.dataset.description import sealed
from astra_data.dataset.format import DATASET_PATH, INFO_PATH

DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def alter_rows(path: Path, column: str, changes: Mapping[int, object]) -> None:
    """Change values of a parquet file, by their rows."""
    table = pq.read_table(path)
    values = table.column(column).to_pylist()
    for row, value in changes.items():
        values[row] = value
    at, field = table.column_names.index(column), table.schema.field(column)
    pq.write_table(table.set_column(at, field, pa.array(values, field.type)), path, row_group_size=10)


def alter(name: str, column: str, row: int, value: object) -> Callable[[Path], None]:
    return lambda root: alter_rows(root / name, column, {row: value})


def retype(name: str, column: str, value: object) -> Callable[[Path], None]:
    """Give all rows of a parquet file the same value, of whatever type; drop the column where it is None."""

    def damage(root: Path) -> None:
        table = pq.read_table(root / name)
        at = table.column_names.index(column)
        others = table.remove_column(at)
        if value is not None:
            others = others.add_column(at, column, pa.array([value] * len(table)))
        pq.write_table(others, root / name)

    return damage


def reseal(root: Path) -> None:
    """Let the description agree with files that were changed."""
    path = root / DATASET_PATH
    path.write_text(json.dumps(sealed(root, json.loads(path.read_text()))))


def edit(name: str, /, **changes: object) -> Callable[[Path], object]:
    """Change keys of a JSON file."""
    return lambda root: (root / name).write_text(json.dumps(json.loads((root / name).read_text()) | changes))


def declare(column: str, **changes: object) -> Callable[[Path], object]:
    """Change how meta/info.json describes a column, or describe one that is not there."""

    def damage(root: Path) -> None:
        features = json.loads((root / INFO_PATH).read_text())["features"]
        edit(INFO_PATH, features=features | {column: features.get(column, {}) | changes})(root)

    return damage


def drop(name: str) -> Callable[[Path], None]:
    return lambda root: (root / name).unlink()


def truncate(name: str) -> Callable[[Path], object]:
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[:-20])


def write(name: str, content: bytes) -> Callable[[Path], object]:
    return lambda root: (root / name).write_bytes(content)
