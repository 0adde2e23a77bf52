"""The contents of a dataset: everything but the values of its columns."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from astra_data.core.arrays import Ints
from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset import format as layout
from astra_data.dataset.columns import Array, Column, Scalar
from astra_data.dataset.description import ContentHash, read_description, read_info, read_subsets
from astra_data.dataset.integrity import SEALED, Digests, alteration, altered_files, digests_of
from astra_data.dataset.lerobot_rows import RecordedFiles
from astra_data.dataset.parquet import read_arrays, read_blocks, rows_of, to_numpy
from astra_data.dataset.plain import data_files, episodes_files, read_footer, read_tasks, runs

_LOCATION = ("episode_index", "length", "data/chunk_index", "data/file_index", "dataset_from_index")


@dataclass(frozen=True, eq=False, repr=False)
class Contents:
    """The metadata of a dataset of E episodes.

    Attributes:
        root: its folder.
        info: meta/info.json.
        description: meta/astra/dataset.json.
        metadata: the episodes' metadata, key to one value per episode, None where one has none.
        uids: uid of each episode, (E,).
        lengths: steps of each episode, (E,).
        order: the permutation of episode indices whose prefixes are the nested subsets.
        subset_seed: its seed.
        task: the task of all episodes.
        paths: the data files in order.
        file_starts: first row of each file.
        recorded: where LeRobot recorded it, how its rows are converted; None for ours.
    """

    root: Path
    info: dict[str, Any]
    description: dict[str, Any]
    metadata: dict[str, list[Scalar | None]]
    uids: Ints
    lengths: Ints
    order: list[int]
    subset_seed: int
    task: str
    paths: list[Path]
    file_starts: Ints
    recorded: RecordedFiles | None = None

    @cached_property
    def starts(self) -> Ints:
        """First row of each episode, (E,)."""
        return np.cumsum(self.lengths) - self.lengths


def read_contents(root: Path) -> Contents:
    """Read the metadata of the dataset in folder `root`, and the footers of its data files."""
    missing = [path for path in (layout.DATASET_PATH, *SEALED) if not (root / path).is_file()]
    if missing:
        raise CorruptDatasetError(f"{', '.join(missing)} missing")
    info, description, subsets = read_info(root), read_description(root), read_subsets(root)
    if info.get("codebase_version") != layout.CODEBASE_VERSION:
        raise CorruptDatasetError(
            f"the format is {info.get('codebase_version')}, expected {layout.CODEBASE_VERSION}"
        )
    columns = [Column.from_feature(name, feature) for name, feature in info["features"].items()]
    tables = list(read_blocks(episodes_files(root), _LOCATION))
    facts = list(read_blocks([root / layout.METADATA_PATH]))
    tasks = read_tasks(root)
    if isinstance(tasks, str) or 0 not in tasks:
        fault = tasks if isinstance(tasks, str) else "has no task 0"
        raise CorruptDatasetError(f"{layout.TASKS_PATH} {fault}")
    empty = {"meta/episodes": tables, layout.METADATA_PATH: facts}
    if not all(empty.values()):
        names = ", ".join(name for name, found in empty.items() if not found)
        raise CorruptDatasetError(f"{names} has no rows")
    metadata = pa.concat_tables(facts).to_pydict()
    index, lengths, chunks, files, starts = (
        to_numpy(pa.concat_tables(tables).column(name), 1, "int64") for name in _LOCATION
    )
    uids = _uids(metadata.pop("episode_uid"))
    listed = metadata.pop("length")
    pattern = info["data_path"]
    rows: dict[Path, int] = {}
    for chunk, file, length in zip(chunks.tolist(), files.tolist(), lengths.tolist(), strict=True):
        path = root / pattern.format(chunk_index=chunk, file_index=file)
        rows[path] = rows.get(path, 0) + length
    faults = []
    if len(index) != info["total_episodes"] or (index != np.arange(len(index))).any():
        faults.append(f"meta/episodes has {len(index)} episodes, expected {info['total_episodes']}")
    if listed != lengths.tolist() or sorted(subsets["uids"]) != sorted(uids.tolist()):
        faults.append(
            f"{layout.METADATA_PATH} or {layout.SUBSETS_PATH} lists other episodes than meta/episodes"
        )
    if lengths.sum() != info["total_frames"] or (starts != np.cumsum(lengths) - lengths).any():
        faults.append(f"meta/episodes adds up to {lengths.sum()} frames, expected {info['total_frames']}")
    faults += _file_faults(root, columns, rows)
    if faults := faults or [f"{path} was altered" for path in altered_files(root, description)]:
        raise CorruptDatasetError("; ".join(faults))
    position = {uid: episode for episode, uid in enumerate(uids.tolist())}
    return Contents(
        root=root,
        info=info,
        description=description,
        metadata=metadata,
        uids=uids,
        lengths=lengths,
        order=[position[uid] for uid in subsets["uids"]],
        subset_seed=subsets["seed"],
        task=tasks[0],
        paths=list(rows),
        file_starts=np.cumsum([0, *rows.values()])[:-1],
    )


def _uids(values: Sequence[object]) -> Ints:
    if not all(type(value) is int and 0 <= value < 2**63 for value in values):
        raise CorruptDatasetError(f"{layout.METADATA_PATH} has an episode_uid that is none")
    return np.array(values, dtype=np.int64)


def _file_faults(root: Path, columns: Sequence[Column], rows: Mapping[Path, int]) -> Iterator[str]:
    """Compare the footers of the data files with the columns and with the number of rows of each."""
    for path in sorted(set(data_files(root)) - set(rows)):
        yield f"{path.relative_to(root)} does not belong to it"
    types = {column.name: layout.arrow_type(column.dtype, column.size) for column in columns}
    for path, expected in rows.items():
        name, footer = path.relative_to(root), read_footer(path)
        if isinstance(footer, str):
            yield f"{name} {footer}"
            continue
        found, schema = footer
        if found != expected:
            yield f"{name} has {found} rows, expected {expected}"
        for key in sorted(set(schema.names) - types.keys()):
            yield f"{name} has an unknown column {key}"
        for key, kind in types.items():
            if key not in schema.names:
                yield f"{name} lacks column {key}"
            elif schema.field(key).type != kind:
                yield f"{name} has {key} as {schema.field(key).type}, expected {kind}"


def read_values(
    contents: Contents, columns: Sequence[Column], episodes: Ints
) -> Iterator[tuple[dict[str, Array], Ints]]:
    """Yield `columns` of `episodes`, ascending indices, in blocks of whole episodes, and the indices of each.

    Row groups of our files are whole episodes; files that another tool rewrote may have any.
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
    """Return the content hash and the digests of all values, as the files have them now."""
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
