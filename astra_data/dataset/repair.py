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
from astra_data.dataset.parquet import UNREADABLE, read_blocks
from astra_data.dataset.plain import (
    PlainColumn,
    Run,
    data_files,
    episodes_files,
    plain_columns,
    read_object,
    read_small_table,
    run_faults,
    runs,
)
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version, successor
from astra_data.dataset.writer import DatasetWriter
from astra_data.errors import BadInputError, CorruptDatasetError

_KEPT = {"name", "version", "seeds", "environment", "simulator", "content_hash"}
"""What a repaired dataset takes over from meta/astra/dataset.json."""
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
    """Write the longest prefix of whole, verified episodes in `folder` to a new dataset `out`.

    Data files are read by their footers, or where a killed writer left none, by their pages. Statistics and
    meta/episodes are made anew.

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
    tasks = _tasks(folder, result.notes)
    metadata = _metadata(folder, result.notes) if like is None else _facts(like.uids.tolist(), like.metadata)
    description = _description(folder, like)
    unknown = 0
    task = " / ".join(tasks) or "unknown"
    seed = _subset_seed(folder if like is None else like.root)
    with DatasetWriter(out, specs, fps=fps, task=task, description=description, subset_seed=seed) as writer:
        for episode, run in enumerate(_whole_runs(folder, info, columns, fps, result.notes)):
            values = {spec.name: run.columns[spec.name].astype(spec.dtype, copy=False) for spec in specs}
            uid = int(run.columns[names.EPISODE_UID][0]) if names.EPISODE_UID in run.columns else episode
            unknown += uid not in metadata
            facts = dict(metadata.get(uid, {}))
            if len(tasks) > 1:
                index = int(run.columns[names.TASK_INDEX][0])
                facts["task"] = tasks[index] if 0 <= index < len(tasks) else "unknown"
            writer.add(Episode(uid, values, facts))
            result.episodes += 1
            result.frames += len(run)
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
    if missing or not isinstance(fps, int | float) or fps < 1 or fps != int(fps):
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
        fits = isinstance(labels, list) and len(labels) == column.size
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


def _tasks(folder: Path, notes: list[str]) -> list[str]:
    """Return the tasks by their index; pandas calls the column after its index."""
    table = read_small_table(folder / TASKS_PATH)
    if isinstance(table, str):
        notes.append(f"{TASKS_PATH} {table}: the task is unknown")
        return []
    texts = [name for name in table.column_names if name != names.TASK_INDEX]
    if len(texts) != 1 or len(texts) == len(table.column_names):
        notes.append(f"{TASKS_PATH} has the columns {', '.join(table.column_names)}: the task is unknown")
        return []
    rows = sorted(table.to_pylist(), key=lambda row: row[names.TASK_INDEX])
    return [str(row[texts[0]]) for row in rows]


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


def _description(folder: Path, like: Dataset | None) -> dict[str, Any]:
    config = {"folder": folder.name}
    if like is not None:
        return successor(like, "episodes", stage="repair", config=config, out=folder)[0]
    old = read_object(folder / DATASET_PATH)
    if isinstance(old, str) or not old.keys() >= _KEPT:
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
    folder: Path, info: Mapping[str, Any], columns: Sequence[PlainColumn], fps: int, notes: list[str]
) -> Iterator[Run]:
    """Yield episode after episode until one is not whole, and note why, and how many are lost."""
    lengths = _lengths(folder, notes)
    episode = row = 0
    uids: set[int] = set()
    try:
        for path in data_files(folder):
            for run in _file_runs(path, columns, notes):
                faults = [fault for _, fault in run_faults(run, number=episode, row=row, fps=fps)]
                if episode in lengths and lengths[episode] != len(run):
                    faults.append(f"episode {episode} has {len(run)} frames, expected {lengths[episode]}")
                uid = int(run.columns.get(names.EPISODE_UID, [episode])[0])
                if uid in uids or uid < 0:
                    faults.append(f"episode {episode} has the uid {uid}, which is taken or negative")
                if faults:
                    notes.append(f"stopped before episode {episode}: {'; '.join(faults)}")
                    return
                yield run
                uids.add(uid)
                episode, row = episode + 1, row + len(run)
    except CorruptDatasetError as error:
        notes.append(f"stopped before episode {episode}: {error}")
    finally:
        counted = info.get("total_episodes")
        if isinstance(counted, int) and counted > episode:
            notes.append(f"{counted - episode} of the {counted} episodes that {INFO_PATH} counts are lost")


def _lengths(folder: Path, notes: list[str]) -> dict[int, int]:
    """Return the lengths that meta/episodes tells, as far as it can be read."""
    lengths: dict[int, int] = {}
    for path in episodes_files(folder):
        try:
            for block in read_blocks([path], ["episode_index", "length"]):
                columns = block.to_pydict()
                lengths |= zip(columns["episode_index"], columns["length"], strict=True)
        except (CorruptDatasetError, KeyError) as error:
            notes.append(f"meta/episodes was made anew from the data: {error}")
    if not lengths and not notes:
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
