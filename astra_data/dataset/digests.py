"""Digests of values: of each episode and stored column the xxh3 (64 bits) of the episode's values.

They stand in meta/astra/digests.parquet: a row per episode, in the dataset's order, and a column per column.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike, NDArray
from xxhash import xxh3_64_intdigest

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.columns import Array
from astra_data.dataset.format import DIGESTS_PATH
from astra_data.dataset.parquet import to_numpy
from astra_data.dataset.plain import Run, read_small_table
from astra_data.dataset.seal import is_sealed

Digests = Mapping[str, NDArray[np.uint64]]
"""Column to the digest of each episode, (E,)."""


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
    """Return the digests of `columns`.

    Args:
        root: folder of the dataset.
        sums: those of its description, see `seal`; empty if they are not known.
        columns: names of all stored columns.
        episodes: their number, if it is known.

    Raises:
        CorruptDatasetError: the file is missing, was altered, or has other columns or rows.
    """
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
