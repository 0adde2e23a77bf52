"""The values of a dataset as its data files have them; `Dataset` verifies them."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest

import numpy as np

from astra_data.core.arrays import Ints
from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.contents import Contents
from astra_data.dataset.description import ContentHash
from astra_data.dataset.digests import Digests, alteration, digests_of
from astra_data.dataset.lerobot_rows import RecordedFiles
from astra_data.dataset.parquet import read_arrays, read_blocks, rows_of
from astra_data.dataset.plain import runs


def read_values(
    contents: Contents, columns: Sequence[Column], episodes: Ints
) -> Iterator[tuple[dict[str, Array], Ints]]:
    """Yield `columns` of `episodes`, ascending indices, in blocks of whole episodes, and the indices of each.

    Row groups of our files are whole episodes; files that another tool rewrote may have any.

    Raises:
        CorruptDatasetError: a file cannot be read, or has other rows than when the dataset was opened.
    """
    if not columns:
        return
    if contents.recorded is not None:
        yield from _converted(contents, contents.recorded, columns, episodes)
        return
    wanted = rows_of(episodes, contents.starts, contents.lengths, int(contents.lengths.sum()))
    ends = np.cumsum(contents.lengths[episodes])
    rest: dict[str, Array] = {}
    row = first = 0
    for block in read_arrays(contents.paths, columns, wanted):
        rest = {name: np.concatenate([rest[name], block[name]]) for name in block} if rest else block
        rows = len(rest[columns[0].name])
        last = int(np.searchsorted(ends, row + rows, side="right"))
        cut = int(ends[last - 1]) - row if last > first else 0
        if cut:
            yield {name: values[:cut] for name, values in rest.items()}, episodes[first:last]
        rest = {name: values[cut:] for name, values in rest.items()} if cut < rows else {}
        row, first = row + cut, last
    if rest or first < len(episodes):
        raise CorruptDatasetError("the data files have other rows than when the dataset was opened")


def _converted(
    contents: Contents, recorded: RecordedFiles, columns: Sequence[Column], episodes: Ints
) -> Iterator[tuple[dict[str, Array], Ints]]:
    """Yield what `read_values` does of a recording of LeRobot, an episode at a time."""
    rows = recorded.rows
    lengths = contents.lengths + rows.dropped
    wanted = rows_of(episodes, recorded.first_rows, lengths, recorded.total_rows)
    stored = rows.stored_for([column.name for column in columns])
    tables = read_blocks(contents.paths, [column.name for column in stored], wanted)
    found = (run for run in runs(contents.root / "data", tables, stored) if len(run) > rows.dropped)
    for position, (episode, run) in enumerate(zip_longest(episodes.tolist(), found)):
        if run is None or episode is None or len(run) != lengths[episode]:
            raise CorruptDatasetError("its files were altered while they were read")
        place = (episode, int(contents.starts[episode]), int(contents.uids[episode]))
        values = {column.name: rows.values(column, run, *place) for column in columns}
        yield values, episodes[position : position + 1]


def measure(contents: Contents) -> tuple[str, Digests]:
    """Return the content hash and the digests of all values, as the files have them now.

    Raises:
        CorruptDatasetError: a file cannot be read, or has other rows than when the dataset was opened.
    """
    columns = [Column.from_feature(name, feature) for name, feature in contents.info["features"].items()]
    content_hash = ContentHash()
    parts: list[Digests] = []
    for block, episodes in read_values(contents, columns, np.arange(len(contents.lengths))):
        for name, values in block.items():
            content_hash.update(name, values)
        parts.append(digests_of(block, contents.lengths[episodes]))
    digests = {column.name: np.concatenate([part[column.name] for part in parts]) for column in columns}
    return content_hash.hexdigest(), digests


def alterations(contents: Contents, altered: Mapping[int, Sequence[str]], episodes: Ints) -> Iterator[str]:
    """Yield a sentence for each altered episode: `altered` has columns by the position in `episodes`."""
    for position, names in altered.items():
        episode = int(episodes[position])
        start = int(contents.starts[episode])
        file = int(np.searchsorted(contents.file_starts, start, side="right")) - 1
        row = start - int(contents.file_starts[file])
        yield alteration(names, contents.paths[file], row, int(contents.lengths[episode]), episode)
