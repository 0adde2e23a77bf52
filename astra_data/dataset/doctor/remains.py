"""What a damaged dataset still tells beside its values."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import columns as names
from astra_data.dataset.columns import Column, Scalar
from astra_data.dataset.declared import DTYPES, declared_columns, name_of, robot_of
from astra_data.dataset.digests import Digests, read_digests
from astra_data.dataset.format import (
    CODEBASE_VERSION,
    DATASET_PATH,
    INFO_PATH,
    METADATA_PATH,
    OUR_FOLDER,
    SUBSETS_PATH,
    TASKS_PATH,
)
from astra_data.dataset.lerobot_rows import Rows, lacking, our_columns
from astra_data.dataset.meta_files import read_description
from astra_data.dataset.plain import (
    PlainColumn,
    is_format_2,
    read_object,
    read_small_table,
    read_tasks,
)
from astra_data.dataset.reader import Dataset
from astra_data.dataset.seal import altered_files
from astra_data.dataset.versions import successor

_LOST = "success, return and the like of the episodes are lost"
_IF_ALTERED = {
    INFO_PATH: "names, units and fps may be wrong",
    TASKS_PATH: "the task may be wrong",
    METADATA_PATH: _LOST,
    SUBSETS_PATH: "the order of the subsets is that of seed 0",
}
"""What follows for the new dataset; statistics are rebuilt, and digests have notes of their own."""


@dataclass(frozen=True)
class Remains:
    """What is known of a damaged dataset before its episodes are read.

    Attributes:
        info: meta/info.json.
        columns: the columns of numbers in its files.
        specs: those of the new dataset.
        fps: steps per second.
        tasks: its tasks by task_index, empty if they are unknown.
        rows: how its rows become ours, where LeRobot recorded it; otherwise None.
        old: its description, empty if there is none to rely on.
        digests: those of its values, empty if they are unknown.
        metadata: the episodes' metadata by uid, empty if there is none to rely on.
        description: of the new dataset.
        subset_seed: of the new dataset.
    """

    info: Mapping[str, Any]
    columns: Sequence[PlainColumn]
    specs: Sequence[Column]
    fps: int
    tasks: Mapping[int, str]
    rows: Rows | None
    old: Mapping[str, Any]
    digests: Digests
    metadata: Mapping[int, dict[str, Scalar]]
    description: Mapping[str, Any]
    subset_seed: int


def remains_of(folder: Path, sources: Sequence[Dataset], notes: list[str]) -> Remains:
    """Read what `folder` still tells; add to `notes` what is lost or changed.

    Args:
        folder: the damaged dataset.
        sources: the datasets from which LeRobot's tools made it, dropping our metadata; empty otherwise.
        notes: a sentence is added for each loss and change.

    Raises:
        CorruptDatasetError: meta/info.json is missing.
        BadInputError: there are `sources`, and no column that joins it with them.
    """
    info = read_object(folder / INFO_PATH)
    if isinstance(info, str):
        raise CorruptDatasetError(f"{folder}: {INFO_PATH} {info}; without it columns and fps are unknown")
    columns, specs, fps = declared_columns(folder, info)
    if sources and names.EPISODE_UID not in info["features"]:
        raise BadInputError(
            f"{folder} has no column {names.EPISODE_UID}, by which it joins {sources[0].reference}"
        )
    tasks = read_tasks(folder)
    rows = _recorded_rows(folder, columns, specs, fps)
    if rows:
        specs = our_columns(specs, has_tasks=not isinstance(tasks, str) and len(tasks) > 1)
    if is_format_2(folder):
        notes.append(f"LeRobot's format {info['codebase_version']} became {CODEBASE_VERSION}")
    notes += _conversions(info, columns, specs)
    if isinstance(tasks, str):
        notes.append(f"{TASKS_PATH} {tasks}: the task is unknown")
        tasks = {}
    # Of what LeRobot's tools made, our metadata is no longer true, where they left it.
    old = {} if sources else _old_description(folder, notes)
    altered = set(_altered_files(folder, old, notes))
    return Remains(
        info=info,
        columns=columns,
        specs=specs,
        fps=fps,
        tasks=tasks,
        rows=rows,
        old=old,
        digests={} if sources else _digests(folder, old, columns, notes),
        metadata={} if sources else _metadata(folder, altered, notes),
        description=_description(folder, info, sources, old),
        subset_seed=sources[0].subset_seed if sources else _subset_seed(folder, altered, notes),
    )


def _recorded_rows(
    folder: Path, columns: Sequence[PlainColumn], specs: Sequence[Column], fps: int
) -> Rows | None:
    """Return how rows become ours that LeRobot recorded without next states, None for other datasets."""
    rows = Rows({column.name: column for column in columns}, fps)
    is_ours = names.EPISODE_UID in rows.stored or (folder / OUR_FOLDER).is_dir()
    return None if is_ours or not rows.dropped or lacking(specs) else rows


def _conversions(
    info: Mapping[str, Any], columns: Sequence[PlainColumn], specs: Sequence[Column]
) -> list[str]:
    notes = []
    ours = {spec.name: spec.dtype for spec in specs}
    others = sorted(info["features"].keys() - {column.name for column in columns})
    if others:
        notes.append(f"left out, because they are not numeric: {', '.join(others)}")
    for column in columns:
        kind = ours.get(column.name, DTYPES[np.dtype(column.dtype).kind])
        if column.dtype != kind:
            notes.append(f"{column.name} was {column.dtype} and is now {kind}")
    return notes


def _old_description(folder: Path, notes: list[str]) -> Mapping[str, Any]:
    """Return meta/astra/dataset.json, empty if there is none to rely on."""
    try:
        return read_description(folder)
    except CorruptDatasetError as error:
        if (folder / DATASET_PATH).exists():
            notes.append(f"{error}: the origin is unknown")
        return {}


def _altered_files(folder: Path, old: Mapping[str, Any], notes: list[str]) -> Iterator[str]:
    for path in altered_files(folder, old):
        if (folder / path).exists():  # a missing one is told where it is read
            if path in _IF_ALTERED:
                notes.append(f"{path} was altered after it was written: {_IF_ALTERED[path]}")
            yield path


def _digests(
    folder: Path, old: Mapping[str, Any], columns: Sequence[PlainColumn], notes: list[str]
) -> Digests:
    if not (folder / OUR_FOLDER).is_dir():
        return {}
    try:
        return read_digests(folder, old.get("sums", {}), [column.name for column in columns])
    except CorruptDatasetError as error:
        notes.append(f"{error}: the values were compared with the content hash only, as a whole")
        return {}


def _metadata(folder: Path, altered: Collection[str], notes: list[str]) -> dict[int, dict[str, Scalar]]:
    """Return the episodes' metadata by uid, empty where there is none to rely on."""
    if METADATA_PATH in altered or not (folder / OUR_FOLDER).is_dir():
        return {}
    table = read_small_table(folder / METADATA_PATH)
    if isinstance(table, str):
        notes.append(f"{METADATA_PATH} {table}: {_LOST}")
        return {}
    columns = table.to_pydict()
    uids = columns.pop(names.EPISODE_UID, [])
    columns.pop("length", None)
    found = {
        uid: {key: value for key, values in columns.items() if (value := values[row]) is not None}
        for row, uid in enumerate(uids)
        if isinstance(uid, int)
    }
    if not found:
        notes.append(f"{METADATA_PATH} has no uids: {_LOST}")
    return found


def _description(
    folder: Path, info: Mapping[str, Any], sources: Sequence[Dataset], old: Mapping[str, Any]
) -> dict[str, Any]:
    config, parents = {"folder": folder.name}, []
    if sources:
        first, *others = sources
        old, parents = first.description, [other.identity for other in others]
    if not old:
        return {
            "name": name_of(folder),
            "stage": "repair",
            "config": config,
            "environment": robot_of(info),
        }
    return successor(old, "episodes", stage="repair", config=config, out=folder, parents=parents)[0]


def _subset_seed(folder: Path, altered: Collection[str], notes: list[str]) -> int:
    """Return the seed of the subsets' order, 0 where there is none to rely on."""
    if SUBSETS_PATH in altered or not (folder / OUR_FOLDER).is_dir():
        return 0
    subsets = read_object(folder / SUBSETS_PATH)
    if isinstance(subsets, dict) and isinstance(seed := subsets.get("seed"), int):
        return seed
    fault = subsets if isinstance(subsets, str) else "has no whole number as its seed"
    notes.append(f"{SUBSETS_PATH} {fault}: {_IF_ALTERED[SUBSETS_PATH]}")
    return 0
