"""The contents of a dataset: everything but the values of its columns."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from astra_data.core.arrays import Ints
from astra_data.core.errors import BadInputError, CorruptDatasetError, in_short
from astra_data.dataset import format as layout
from astra_data.dataset import plain
from astra_data.dataset.cameras import Camera, read_cameras
from astra_data.dataset.columns import Array, Column, Scalar
from astra_data.dataset.description import altered_files, read_description
from astra_data.dataset.lerobot_rows import RecordedFiles
from astra_data.dataset.parquet import read_arrays, read_blocks, rows_of, to_numpy
from astra_data.dataset.plain import PlainColumn

_LOCATION = ("length", "data/chunk_index", "data/file_index")


@dataclass(frozen=True, eq=False, repr=False)
class Contents:
    """The metadata of a dataset of E episodes."""

    root: Path
    info: dict[str, Any]  # meta/info.json
    description: dict[str, Any]  # meta/astra/dataset.json
    metadata: dict[str, list[Scalar | None]]  # key to one value per episode, None where one has none
    uids: Ints  # (E,)
    lengths: Ints  # steps of each episode, (E,)
    order: list[int]  # the permutation of episode indices whose prefixes are the nested subsets
    subset_seed: int
    task: str
    paths: list[Path]  # the data files in order
    file_starts: Ints  # first row of each file
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    recorded: RecordedFiles | None = None  # where LeRobot recorded it, how its rows are converted

    @cached_property
    def starts(self) -> Ints:
        """First row of each episode, (E,)."""
        return np.cumsum(self.lengths) - self.lengths


def read_contents(root: Path) -> Contents:
    """Read the metadata of the dataset in folder `root`, and the footers of its data files."""
    description = read_description(root)
    if altered := altered_files(root, description):
        faults = (f"{path} {'was altered' if (root / path).exists() else 'missing'}" for path in altered)
        raise CorruptDatasetError("; ".join(faults))
    try:
        return _parsed(root, description)
    except (BadInputError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise CorruptDatasetError(f"its metadata are not those of a dataset ({in_short(error)})") from error


def _parsed(root: Path, description: dict[str, Any]) -> Contents:
    """Read what is sealed, and therefore as the writer wrote it, unless somebody forged it."""
    info, subsets = (
        json.loads((root / path).read_text(encoding="utf-8")) for path in (layout.INFO_PATH, layout.SUBSETS_PATH)
    )
    if not plain.is_data_path(info["data_path"]):
        raise BadInputError(f"expected a path inside the dataset's folder, got {info['data_path']!r}")
    cameras, faults_of = read_cameras(root, info)
    info["features"] = {name: it for name, it in info["features"].items() if name not in {*cameras, *faults_of}}
    columns = [Column.from_feature(name, feature) for name, feature in info["features"].items()]
    tables = pa.concat_tables(read_blocks(plain.episodes_files(root), _LOCATION))
    lengths, chunks, files = (to_numpy(tables.column(name), 1, "int64") for name in _LOCATION)
    metadata = pa.concat_tables(read_blocks([root / layout.METADATA_PATH])).to_pydict()
    del metadata["length"]
    uids = metadata.pop("episode_uid")
    rows: dict[Path, int] = {}
    for chunk, file, length in zip(chunks.tolist(), files.tolist(), lengths.tolist(), strict=True):
        path = root / info["data_path"].format(chunk_index=chunk, file_index=file)
        rows[path] = rows.get(path, 0) + length
    faults = [f"{name}: {fault}" for name, fault in faults_of.items()]
    faults += [
        f"{path.relative_to(root)} does not belong to it" for path in sorted({*plain.data_files(root)} - {*rows})
    ]
    for path, expected in rows.items():
        name, footer = path.relative_to(root), plain.read_footer(path)
        if isinstance(footer, str):
            faults.append(f"{name} {footer}")
            continue
        faults += [f"{name} has {footer[0]} rows, expected {expected}"] if footer[0] != expected else []
        stored = [PlainColumn(column.name, column.dtype, column.size) for column in columns]
        faults += [f"{name} {fault}" for fault in plain.schema_faults(footer[1], stored)]
    tasks = plain.read_tasks(root)
    if isinstance(tasks, str) or 0 not in tasks:
        faults.append(f"{layout.TASKS_PATH} {tasks if isinstance(tasks, str) else 'has no task 0'}")
    if faults:
        raise CorruptDatasetError("; ".join(faults))
    position = {uid: episode for episode, uid in enumerate(uids)}
    return Contents(
        root=root,
        info=info,
        description=description,
        metadata=metadata,
        uids=np.array(uids, dtype=np.int64),
        lengths=lengths,
        order=[position[uid] for uid in subsets["uids"]],
        subset_seed=int(subsets["seed"]),
        task=tasks[0],
        paths=list(rows),
        file_starts=np.cumsum([0, *rows.values()])[:-1],
        cameras=cameras,
    )


def read_values(
    contents: Contents, columns: Sequence[Column], episodes: Ints
) -> Iterator[tuple[dict[str, Array], Ints]]:
    """Yield `columns` of `episodes`, ascending indices, in blocks of whole episodes, and the indices of each."""
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
    stored = list(rows.stored.values())
    tables = read_blocks(contents.paths, list(rows.stored), wanted)
    found = (run for run in plain.runs(contents.root / "data", tables, stored) if len(run) > rows.dropped)
    for position, (episode, run) in enumerate(zip_longest(episodes.tolist(), found)):
        if run is None or episode is None or len(run) != lengths[episode]:
            raise CorruptDatasetError("its files were altered while they were read")
        place = (episode, int(contents.starts[episode]), int(contents.uids[episode]))
        yield rows.values(columns, run, *place), episodes[position : position + 1]
