"""Digests of values: of each episode and stored column the xxh3 (64 bits) of the episode's values.

They stand in meta/astra/digests.parquet: a row per episode, in the dataset's order, and a column per column.
"""

import hashlib
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise
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
from astra_data.dataset.format import DIGESTS_PATH
from astra_data.dataset.parquet import to_numpy
from astra_data.dataset.plain import Run, episodes_files, read_small_table

Digests = Mapping[str, NDArray[np.uint64]]
"""Column to the digest of each episode, (E,)."""
_EPISODES = re.compile(r"meta/episodes/[\w-]+/[\w-]+\.parquet")
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


def digests_of(columns: Mapping[str, Array], lengths: ArrayLike) -> dict[str, NDArray[np.uint64]]:
    """Return the digests of episodes of `lengths` (E,) steps in contiguous `columns` (n,) or (n, size)."""
    ends = [0, *np.cumsum(lengths).tolist()]
    return {
        name: np.array([digest_of(values[first:last]) for first, last in pairwise(ends)], np.uint64)
        for name, values in columns.items()
    }


def altered_columns(found: Digests, stored: Digests) -> dict[int, list[str]]:
    """Return the columns of `found` that differ from those `stored`, by the position of their episode."""
    altered: dict[int, list[str]] = {}
    for name, digests in found.items():
        for position in np.flatnonzero(digests != stored[name]).tolist():
            altered.setdefault(position, []).append(name)
    return dict(sorted(altered.items()))


def alteration(columns: Sequence[str], path: Path, row: int, steps: int, episode: int) -> str:
    """Say that `columns` were altered in an episode of `steps`, from `row` of the file at `path`."""
    where = f"{path.parent.parent.name}/{path.parent.name}/{path.name} rows {row} to {row + steps - 1}"
    return f"{', '.join(columns)}: other values than were written in {where} (episode {episode})"


def run_alterations(run: Run, episode: int, digests: Digests) -> list[str]:
    """Return a sentence if `run` is not `episode` as it was written, in the columns with digests."""
    stored = {name: digests[name][episode : episode + 1] for name in run.columns if name in digests}
    found = digests_of({name: run.columns[name] for name in stored}, [len(run)])
    altered = altered_columns(found, stored).values()
    return [alteration(names, run.path, run.row, len(run), episode) for names in altered]


def write_digests(root: Path, digests: Mapping[str, ArrayLike]) -> None:
    """Write meta/astra/digests.parquet, plain: random bits neither compress nor repeat."""
    table = pa.table({name: pa.array(np.asarray(values, np.uint64)) for name, values in digests.items()})
    pq.write_table(
        table, root / DIGESTS_PATH, compression="none", use_dictionary=False, write_statistics=False
    )


def read_digests(
    root: Path, sums: Mapping[str, str], columns: Collection[str], episodes: int | None = None
) -> dict[str, NDArray[np.uint64]]:
    """Return the digests of `columns`."""
    path = root / DIGESTS_PATH
    table = read_small_table(path)
    if isinstance(table, str):
        raise CorruptDatasetError(f"{DIGESTS_PATH} {table}")
    if DIGESTS_PATH in sums and not is_sealed(path, sums[DIGESTS_PATH]):
        raise CorruptDatasetError(f"{DIGESTS_PATH} was altered")
    whole = [field.name for field in table.schema if field.type == pa.uint64()]
    others = sorted(whole) != sorted(columns) or any(column.null_count for column in table.columns)
    if others or len(table) != (len(table) if episodes is None else episodes):
        raise CorruptDatasetError(f"{DIGESTS_PATH} has other columns or episodes than the data")
    return {name: to_numpy(table.column(name), 1, "uint64") for name in columns}


def sealed(root: Path, description: Mapping[str, Any]) -> dict[str, Any]:
    """Return `description`, as JSON gives it back, with the sums of the files in folder `root`."""
    sums = {path: file_digest(root / path) for path in (*SEALED, *_episodes(root))}
    full: dict[str, Any] = json.loads(json.dumps({**description, "sums": sums}))
    full["sums"][layout.DATASET_PATH] = _own_sum(full)
    return full


def is_description_sealed(description: Mapping[str, Any]) -> bool:
    """Return whether `description` is as it was sealed."""
    return bool(description["sums"].get(layout.DATASET_PATH) == _own_sum(description))


def is_sealed(path: Path, expected: str | None) -> bool:
    """Return whether the file at `path` has the sum `expected`."""
    return path.is_file() and file_digest(path) == expected


def altered_files(root: Path, description: Mapping[str, Any]) -> Iterator[str]:
    """Yield the sealed files in folder `root` that were altered or are missing, and those added to them."""
    sums = description.get("sums", {})
    listed = [path for path in sums if _EPISODES.fullmatch(path)]
    for path in (*(path for path in SEALED if path in sums), *sorted({*listed, *_episodes(root)})):
        if sums and not is_sealed(root / path, sums.get(path)):
            yield path


def _episodes(root: Path) -> list[str]:
    return [path.relative_to(root).as_posix() for path in episodes_files(root)]


def _own_sum(description: Mapping[str, Any]) -> str:
    sums = {path: value for path, value in description["sums"].items() if path != layout.DATASET_PATH}
    text = json.dumps({**description, "sums": sums}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
