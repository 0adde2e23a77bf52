"""Save what is whole of a broken LeRobot dataset, ours or another's, into a new one."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data import columns as names
from astra_data.columns import Column, Episode, Scalar
from astra_data.dataset.footerless import rebuilt_metadata
from astra_data.dataset.format import (
    DATASET_PATH,
    DEFAULT_COLUMNS,
    INFO_PATH,
    METADATA_PATH,
    SUBSETS_PATH,
    TASKS_PATH,
)
from astra_data.dataset.meta_files import read_description
from astra_data.dataset.parquet import UNREADABLE, read_blocks
from astra_data.dataset.plain import (
    MOST_FPS,
    PlainColumn,
    Run,
    data_files,
    episodes_files,
    flag_faults,
    plain_columns,
    read_object,
    read_small_table,
    read_tasks,
    run_faults,
    runs,
)
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version, successor
from astra_data.dataset.writer import DatasetWriter
from astra_data.errors import BadInputError, CorruptDatasetError

_STRUCTURE = {
    *(names.INDEX, names.EPISODE_INDEX, names.FRAME_INDEX),
    *(names.TIMESTAMP, names.EPISODE_UID),
}
"""Columns that tell where episodes begin: where they are wrong, so may be all that follows."""
_DTYPES = {"f": "float32", "i": "int64", "u": "int64", "b": "bool"}


@dataclass
class Repaired:
    """What `repair` saved.

    Attributes:
        episodes: number of episodes saved. frames: number of steps.
        notes: what was lost or changed, a sentence each.
    """

    episodes: int = 0
    frames: int = 0
    notes: list[str] = field(default_factory=list)


def repair(folder: Path, *, out: Path, like: Dataset | None = None) -> Repaired:
    """Write the whole, verified episodes in `folder` to a new dataset `out`.

    An episode whose values are wrong is left out; so is all that follows once it is unclear where episodes
    begin, or a file cannot be read. Data files are read by their footers, or where a killed writer left none,
    by their pages. Statistics and meta/episodes are made anew.

    Args:
        folder: the broken dataset; it is not touched.
        out: folder of the new one.
        like: the dataset that `folder` was made from by LeRobot's tools, which drop our metadata: origin and
            the episodes' metadata are taken from it, joined by episode_uid.

    Raises:
        CorruptDatasetError: meta/info.json is gone, or there is not one whole episode.
        BadInputError: `out` exists, or episodes cannot be joined with `like`.
    """
    info = read_object(folder / INFO_PATH)
    if isinstance(info, str):
        raise CorruptDatasetError(f"{folder}: {INFO_PATH} {info}; without it columns and fps are unknown")
    columns, specs, fps = _declared(folder, info)
    if like is not None and names.EPISODE_UID not in info["features"]:
        raise BadInputError(f"{folder} has no column {names.EPISODE_UID}, by which it joins {like.reference}")
    result = Repaired(notes=_conversions(info, columns))
    tasks = read_tasks(folder)
    if isinstance(tasks, str):
        result.notes.append(f"{TASKS_PATH} {tasks}: the task is unknown")
        tasks = {}
    metadata = _metadata(folder, result.notes) if like is None else _facts(like.uids.tolist(), like.metadata)
    description = _description(folder, like, result.notes)
    unknown = 0
    task = " / ".join(str(tasks[index]) for index in sorted(tasks)) or "unknown"
    seed = _subset_seed(folder if like is None else like.root)
    with DatasetWriter(out, specs, fps=fps, task=task, description=description, subset_seed=seed) as writer:
        for uid, run in _whole_runs(folder, columns, fps, result.notes):
            values = {spec.name: run.columns[spec.name].astype(spec.dtype, copy=False) for spec in specs}
            unknown += uid not in metadata
            facts = dict(metadata.get(uid, {}))
            if len(tasks) > 1:
                facts["task"] = tasks.get(int(run.columns[names.TASK_INDEX][0]), "unknown")
            writer.add(Episode(uid, values, facts))
            result.episodes += 1
            result.frames += len(run)
        counted = info.get("total_episodes")
        if isinstance(counted, int) and counted > result.episodes:
            lost = counted - result.episodes
            result.notes.append(f"{lost} of the {counted} episodes that {INFO_PATH} counts are lost")
        if not result.episodes:
            raise CorruptDatasetError(f"{folder}: not one whole episode; {'; '.join(result.notes)}")
    if metadata and unknown:
        result.notes.append(f"{unknown} episodes have no metadata: their uids are not among the known ones")
    if len(tasks) > 1:
        result.notes.append(
            f"the {len(tasks)} tasks became one, the episodes' own is in their metadata 'task'"
        )
    return result


def _declared(folder: Path, info: Mapping[str, Any]) -> tuple[list[PlainColumn], list[Column], int]:
    """Return the readable columns, those of them that the writer takes, and the fps, from info.json."""
    features, fps = info.get("features"), info.get("fps")
    columns = plain_columns(features)[0] if isinstance(features, dict) else []
    missing = sorted({c.name for c in DEFAULT_COLUMNS} - {column.name for column in columns})
    if missing or not isinstance(fps, int | float) or not 1 <= fps < MOST_FPS or fps != int(fps):
        raise CorruptDatasetError(
            f"{folder}: {INFO_PATH} has fps {fps!r} and lacks the columns {', '.join(missing) or 'none'}; "
            "expected a whole number of frames per second and all of LeRobot's own columns"
        )
    assert isinstance(features, dict)
    specs = []
    for column in columns:
        if column.name in names.RESERVED:
            continue
        feature = features[column.name]
        labels = feature.get("names")
        fits = isinstance(labels, list) and [type(label) for label in labels] == [str] * column.size
        kind = _DTYPES[np.dtype(column.dtype).kind]
        known = feature | {"dtype": kind, "names": labels if fits else None}
        specs.append(Column.from_feature(column.name, known))
    return columns, specs, int(fps)


def _conversions(info: Mapping[str, Any], columns: Sequence[PlainColumn]) -> list[str]:
    notes = []
    others = sorted(info["features"].keys() - {column.name for column in columns})
    if others:
        notes.append(f"left out, for they are not rows of numbers: {', '.join(others)}")
    for column in columns:
        kind = _DTYPES[np.dtype(column.dtype).kind]
        if column.dtype != kind:
            notes.append(f"{column.name} was {column.dtype} and is now {kind}")
    return notes


def _metadata(folder: Path, notes: list[str]) -> dict[int, dict[str, Scalar]]:
    """Return the episodes' metadata by uid, empty where there is none."""
    if not (folder / "meta/astra").is_dir():
        return {}
    table = read_small_table(folder / METADATA_PATH)
    if isinstance(table, str):
        notes.append(f"{METADATA_PATH} {table}: success, return and the like of the episodes are lost")
        return {}
    columns = table.to_pydict()
    uids = columns.pop(names.EPISODE_UID, [])
    columns.pop("length", None)
    return _facts(uids, columns)


def _facts(
    uids: Sequence[int], metadata: Mapping[str, Sequence[Scalar | None]]
) -> dict[int, dict[str, Scalar]]:
    return {
        uid: {key: value for key, values in metadata.items() if (value := values[row]) is not None}
        for row, uid in enumerate(uids)
    }


def _description(folder: Path, like: Dataset | None, notes: list[str]) -> dict[str, Any]:
    config = {"folder": folder.name}
    if like is not None:
        return successor(like, "episodes", stage="repair", config=config, out=folder)[0]
    try:
        old = read_description(folder)
    except CorruptDatasetError as error:
        if (folder / DATASET_PATH).exists():
            notes.append(f"{error}: the origin is unknown")
        name = re.sub(r"[^A-Za-z0-9._-]+|^[^A-Za-z0-9]+", "-", folder.resolve().name).lstrip("-._")
        return {"name": name or "repaired", "stage": "repair", "config": config}
    kept = {key: old[key] for key in ("name", "seeds", "environment", "simulator")}
    version = Version.parse(old["version"])
    parent = {"name": old["name"], "version": old["version"], "hash": old["content_hash"]}
    changed = {"version": str(version.next("episodes")), "parents": [parent]}
    return {**kept, **changed, "stage": "repair", "config": config}


def _subset_seed(folder: Path) -> int:
    subsets = read_object(folder / SUBSETS_PATH)
    seed = 0 if isinstance(subsets, str) else subsets.get("seed")
    return seed if isinstance(seed, int) else 0


def _whole_runs(
    folder: Path, columns: Sequence[PlainColumn], fps: int, notes: list[str]
) -> Iterator[tuple[int, Run]]:
    """Yield the uid and the rows of each whole episode, and note which are left out, and where it stops."""
    lengths = _lengths(folder, notes)
    episode = row = 0
    uids: set[int] = set()
    every = (run for path in data_files(folder) for run in _file_runs(path, columns, notes))
    try:
        for run in every:
            found = list(run_faults(run, number=episode, row=row, fps=fps))
            structural = [fault for name, fault in found if name in _STRUCTURE]
            if lengths.get(episode, len(run)) != len(run):
                structural.append(f"episode {episode} has {len(run)} frames, expected {lengths[episode]}")
            if structural:
                notes.append(f"stopped before episode {episode}: {'; '.join(structural)}")
                return
            faults = [*(fault for _, fault in found), *flag_faults(run, episode)]
            uid = int(run.columns.get(names.EPISODE_UID, [episode])[0])
            if uid in uids or uid < 0:
                faults.append(f"its uid {uid} is taken or negative")
            if faults:
                notes.append(f"left out episode {episode}: {'; '.join(faults)}")
            else:
                uids.add(uid)
                yield uid, run
            episode, row = episode + 1, row + len(run)
    except CorruptDatasetError as error:
        notes.append(f"stopped before episode {episode}: {error}")


def _lengths(folder: Path, notes: list[str]) -> dict[int, int]:
    """Return the lengths that meta/episodes tells, as far as it can be read."""
    lengths: dict[int, int] = {}
    before = len(notes)
    for path in episodes_files(folder):
        try:
            for block in read_blocks([path], ["episode_index", "length"]):
                columns = block.to_pydict()
                lengths |= zip(columns["episode_index"], columns["length"], strict=True)
        except (CorruptDatasetError, KeyError) as error:
            notes.append(f"meta/episodes was made anew from the data: {error}")
    if not lengths and len(notes) == before:
        notes.append("meta/episodes was missing and was made anew from the data")
    return lengths


def _file_runs(path: Path, columns: Sequence[PlainColumn], notes: list[str]) -> Iterator[Run]:
    wanted = [column.name for column in columns]
    try:
        with pq.ParquetFile(path) as file:
            file.schema_arrow  # noqa: B018 - raises where names are no text
    except UNREADABLE:
        pass
    else:
        yield from runs(path, read_blocks([path], wanted), columns)
        return
    schema = pa.schema([(column.name, column.arrow_type) for column in columns])
    metadata = rebuilt_metadata(path, schema)
    rows: list[int] = []
    held: Run | None = None
    for run in runs(path, _row_groups(path, metadata, wanted, rows), columns):
        if held is not None:
            yield held
        held = run
    notes.append(
        f"{path.parent.name}/{path.name} has no footer: {len(rows)} whole row groups were found in it"
    )
    # LeRobot writes one row group per episode. Where groups are cut otherwise, the last one may be.
    if held is not None and len(held) == rows[-1]:
        yield held
    elif held is not None:
        notes.append(
            f"the last {len(held)} frames in {path.name} may be part of an episode and were left out"
        )


def _row_groups(
    path: Path, metadata: pq.FileMetaData, wanted: Sequence[str], rows: list[int]
) -> Iterator[pa.Table]:
    """Yield row groups up to the first that cannot be read, and append their numbers of rows to `rows`."""
    with pq.ParquetFile(path, metadata=metadata) as file:
        for group in range(metadata.num_row_groups):
            try:
                table = file.read_row_group(group, columns=wanted, use_threads=False)
            except UNREADABLE:
                return
            rows.append(table.num_rows)
            yield table
