"""Digests and sums, by which altered values and files are known.

Of each episode and stored column, meta/astra/digests.parquet has the xxh3 (64 bits) of its values: a row per
episode, in the dataset's order. meta/astra/dataset.json has the sha256 of the other small files, and its own.
"""

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike, NDArray
from xxhash import xxh3_64_intdigest

from astra_data.core.durable import file_digest
from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset import format as layout
from astra_data.dataset.columns import Array
from astra_data.dataset.format import DATASET_PATH, DIGESTS_PATH
from astra_data.dataset.parquet import to_numpy
from astra_data.dataset.plain import episodes_files, read_small_table

Digests = Mapping[str, NDArray[np.uint64]]
"""Column to the digest of each episode, (E,)."""
SEALED = (
    layout.INFO_PATH,
    layout.STATS_PATH,
    layout.TASKS_PATH,
    layout.METADATA_PATH,
    layout.SUBSETS_PATH,
    layout.DIGESTS_PATH,
)
"""The files with a sum, beside the description and those of meta/episodes."""


def digest_of(values: Array) -> int:
    """Return the digest of contiguous `values` (T,) or (T, size) of one episode."""
    return xxh3_64_intdigest(values)


def altered_columns(columns: Mapping[str, Array], episode: int, digests: Digests) -> list[str]:
    """Return which `columns` of one episode differ from their digests, as far as these are known."""
    return [
        name
        for name, values in columns.items()
        if name in digests and episode < len(digests[name]) and digest_of(values) != digests[name][episode]
    ]


def alteration(columns: Sequence[str], path: Path, row: int, steps: int, episode: int) -> str:
    """Say that `columns` were altered in an episode of `steps`, from `row` of the file at `path`."""
    where = f"{'/'.join(path.parts[-3:])} rows {row} to {row + steps - 1}"
    return f"{', '.join(columns)}: other values than were written in {where} (episode {episode})"


def write_digests(root: Path, digests: Mapping[str, ArrayLike]) -> None:
    """Write meta/astra/digests.parquet, plain: random bits neither compress nor repeat."""
    table = pa.table({name: pa.array(np.asarray(values, np.uint64)) for name, values in digests.items()})
    pq.write_table(
        table, root / DIGESTS_PATH, compression="none", use_dictionary=False, write_statistics=False
    )


def read_digests(root: Path, columns: Collection[str], altered: Collection[str] = ()) -> Digests:
    """Return the digests of `columns`, unless their file is among those `altered`."""
    table = "was altered" if DIGESTS_PATH in altered else read_small_table(root / DIGESTS_PATH)
    if isinstance(table, str):
        raise CorruptDatasetError(f"{DIGESTS_PATH} {table}")
    whole = [field.name for field in table.schema if field.type == pa.uint64()]
    if sorted(whole) != sorted(columns) or any(column.null_count for column in table.columns):
        raise CorruptDatasetError(f"{DIGESTS_PATH} has other columns than the data")
    return {name: to_numpy(table.column(name), 1, "uint64") for name in columns}


def sealed(root: Path, description: Mapping[str, Any]) -> dict[str, Any]:
    """Return `description`, as JSON gives it back, with the sums of the files in folder `root`."""
    sums = {path: file_digest(root / path) for path in (*SEALED, *_episodes(root))}
    full: dict[str, Any] = json.loads(json.dumps({**description, "sums": sums}))
    full["sums"][DATASET_PATH] = _sum_of(full)
    return full


def is_sealed(description: Mapping[str, Any]) -> bool:
    """Return whether `description` is as it was sealed."""
    sums = description.get("sums")
    return isinstance(sums, dict) and sums.get(DATASET_PATH) == _sum_of(description)


def altered_files(root: Path, description: Mapping[str, Any]) -> list[str]:
    """Return the sealed files in folder `root` that were altered or are missing, and those added to them."""
    sums = {path: value for path, value in description.get("sums", {}).items() if path != DATASET_PATH}
    paths = (*SEALED, *sorted({*sums, *_episodes(root)} - {*SEALED})) if sums else ()
    return [
        path for path in paths if not (root / path).is_file() or file_digest(root / path) != sums.get(path)
    ]


def _episodes(root: Path) -> list[str]:
    return [path.relative_to(root).as_posix() for path in episodes_files(root)]


def _sum_of(description: Mapping[str, Any]) -> str:
    sums = {path: value for path, value in description["sums"].items() if path != DATASET_PATH}
    text = json.dumps({**description, "sums": sums}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
