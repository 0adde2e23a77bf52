"""Save the intact episodes of a damaged LeRobot dataset, ours or another tool's, into a new one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import columns as names
from astra_data.dataset.columns import Episode, Scalar
from astra_data.dataset.declared import DTYPES, declared_columns, name_of
from astra_data.dataset.doctor.joining import Joined, join
from astra_data.dataset.doctor.salvage import whole_runs
from astra_data.dataset.format import (
    DATASET_PATH,
    INFO_PATH,
    METADATA_PATH,
    POLICY_PATH,
    SUBSETS_PATH,
    TASKS_PATH,
)
from astra_data.dataset.meta_files import read_description
from astra_data.dataset.plain import (
    PlainColumn,
    read_object,
    read_small_table,
    read_tasks,
)
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version, successor
from astra_data.dataset.writer import DatasetWriter


@dataclass
class Repaired:
    """The result of `repair`.

    Attributes:
        episodes: number of episodes saved.
        frames: number of steps saved.
        notes: losses and changes, a sentence each.
    """

    episodes: int = 0
    frames: int = 0
    notes: list[str] = field(default_factory=list)


def repair(
    folder: Path, *, out: Path, like: Dataset | Sequence[Dataset] | None = None, new_uids: bool = False
) -> Repaired:
    """Write the intact episodes of `folder` to a new dataset `out`.

    Episodes with wrong values are left out, and all that follow once it is unclear where episodes begin, or a
    file cannot be read. Data files without a footer, which a killed writer leaves, are read page by page.
    Statistics and meta/episodes are rebuilt.

    Args:
        folder: the damaged dataset; it is not changed.
        out: folder of the new one.
        like: the dataset from which LeRobot's tools made `folder`, dropping our metadata: provenance and the
            episodes' metadata are taken from it, joined by episode_uid. Or several, of which the first gives
            the provenance: metadata is then joined by uid and values, as it is with `new_uids`.
        new_uids: give an episode whose uid an earlier one has a new one, the same in every run, and keep the
            old one as "merged_uid"; otherwise it is left out.

    Raises:
        CorruptDatasetError: meta/info.json is missing, or no episode is intact.
        BadInputError: `out` exists, or episodes cannot be joined with `like`.
    """
    info = read_object(folder / INFO_PATH)
    if isinstance(info, str):
        raise CorruptDatasetError(f"{folder}: {INFO_PATH} {info}; without it columns and fps are unknown")
    columns, specs, fps = declared_columns(folder, info)
    sources = [like] if isinstance(like, Dataset) else list(like or ())
    first = sources[0] if sources else None
    if first is not None and names.EPISODE_UID not in info["features"]:
        raise BadInputError(
            f"{folder} has no column {names.EPISODE_UID}, by which it joins {first.reference}"
        )
    result = Repaired(notes=_conversions(info, columns))
    tasks = read_tasks(folder)
    if isinstance(tasks, str):
        result.notes.append(f"{TASKS_PATH} {tasks}: the task is unknown")
        tasks = {}
    metadata = (
        _metadata(folder, result.notes) if first is None else _facts(first.uids.tolist(), first.metadata)
    )
    description = _description(folder, sources, result.notes)
    unknown = 0
    task = " / ".join(str(tasks[index]) for index in sorted(tasks)) or "unknown"
    seed = _subset_seed(folder if first is None else first.root)
    joined: list[Joined] = []
    if new_uids or len(sources) > 1:
        whole = whole_runs(folder, columns, fps, [], repeated=new_uids)
        joined = join(((uid, run.columns) for uid, run in whole), specs, sources)
        renamed = sum("merged_uid" in episode.metadata for episode in joined)
        result.notes += [f"{renamed} episodes have new uids, because theirs were taken"] if renamed else []
    with DatasetWriter(out, specs, fps=fps, task=task, description=description, subset_seed=seed) as writer:
        for uid, run in whole_runs(folder, columns, fps, result.notes, repeated=new_uids):
            values = {spec.name: run.columns[spec.name].astype(spec.dtype, copy=False) for spec in specs}
            known = Joined(uid, dict(metadata.get(uid, {})), uid in metadata)
            if joined:
                known = joined[result.episodes]
            unknown += not known.is_known
            facts = known.metadata
            if len(tasks) > 1:
                facts["task"] = tasks.get(int(run.columns[names.TASK_INDEX][0]), "unknown")
            writer.add(Episode(known.uid, values, facts))
            result.episodes += 1
            result.frames += len(run)
        counted = info.get("total_episodes")
        if isinstance(counted, int) and counted > result.episodes:
            lost = counted - result.episodes
            result.notes.append(f"{lost} of the {counted} episodes that {INFO_PATH} counts are lost")
        written = read_object(folder / DATASET_PATH)
        is_all = first is None and counted == result.episodes and len(columns) == len(info["features"])
        if is_all and not isinstance(written, str) and written.get("content_hash") != writer.content_hash:
            result.notes.append(
                "a value was altered after it was written, because the content hash differs; which one is "
                "unknown"
            )
        writer.made = {"repaired": result.notes}
        writer.policy = policy if (policy := folder / POLICY_PATH).is_file() else None
        if not result.episodes:
            raise CorruptDatasetError(f"{folder}: not one whole episode; {'; '.join(result.notes)}")
    if metadata and unknown:
        result.notes.append(f"{unknown} episodes have no metadata: they are not among the known ones")
    if len(tasks) > 1:
        result.notes.append(
            f"the {len(tasks)} tasks were merged into one; each episode's own is in its metadata 'task'"
        )
    return result


def _conversions(info: Mapping[str, Any], columns: Sequence[PlainColumn]) -> list[str]:
    notes = []
    others = sorted(info["features"].keys() - {column.name for column in columns})
    if others:
        notes.append(f"left out, because they are not numeric: {', '.join(others)}")
    for column in columns:
        kind = DTYPES[np.dtype(column.dtype).kind]
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


def _description(folder: Path, sources: Sequence[Dataset], notes: list[str]) -> dict[str, Any]:
    config = {"folder": folder.name}
    if sources:
        first, *others = sources
        return successor(first, "episodes", stage="repair", config=config, out=folder, parents=others)[0]
    try:
        old = read_description(folder)
    except CorruptDatasetError as error:
        if (folder / DATASET_PATH).exists():
            notes.append(f"{error}: the origin is unknown")
        return {"name": name_of(folder), "stage": "repair", "config": config}
    kept = {key: old[key] for key in ("name", "seeds", "environment", "simulator")}
    version = Version.parse(old["version"])
    parent = {"name": old["name"], "version": old["version"], "hash": old["content_hash"]}
    changed = {"version": str(version.next("episodes")), "parents": [parent]}
    return {**kept, **changed, "stage": "repair", "config": config}


def _subset_seed(folder: Path) -> int:
    subsets = read_object(folder / SUBSETS_PATH)
    seed = 0 if isinstance(subsets, str) else subsets.get("seed")
    return seed if isinstance(seed, int) else 0
