"""Save the intact episodes of a damaged LeRobot dataset, ours or another tool's, into a new one."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import columns as names
from astra_data.dataset.columns import Array, Column, Episode, Scalar
from astra_data.dataset.declared import DTYPES, declared_columns, name_of, robot_of
from astra_data.dataset.digests import Digests, read_digests
from astra_data.dataset.doctor.joining import Joined, join
from astra_data.dataset.doctor.salvage import whole_runs
from astra_data.dataset.format import (
    DATASET_PATH,
    INFO_PATH,
    METADATA_PATH,
    OUR_FOLDER,
    POLICY_PATH,
    SUBSETS_PATH,
    TASKS_PATH,
)
from astra_data.dataset.lerobot_recording import Found, found_in, left_out
from astra_data.dataset.lerobot_rows import Rows, lacking, our_columns
from astra_data.dataset.meta_files import read_description
from astra_data.dataset.opening import refuse_run
from astra_data.dataset.plain import (
    PlainColumn,
    Run,
    read_object,
    read_small_table,
    read_tasks,
)
from astra_data.dataset.reader import Dataset
from astra_data.dataset.seal import altered_files
from astra_data.dataset.versions import successor
from astra_data.dataset.writer import DatasetWriter

_LOST = "success, return and the like of the episodes are lost"
_IF_ALTERED = {
    INFO_PATH: "names, units and fps may be wrong",
    TASKS_PATH: "the task may be wrong",
    METADATA_PATH: _LOST,
    SUBSETS_PATH: "the order of the subsets is that of seed 0",
}
"""What follows for the new dataset; statistics are rebuilt, and digests have notes of their own."""


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

    Episodes with wrong values, or with other values than were written, are left out, and all that follow once
    it is unclear where episodes begin, or a file cannot be read. Data files without a footer, which a killed
    writer leaves, are read page by page. Statistics and meta/episodes are rebuilt. What LeRobot recorded
    without next states becomes what `Dataset.open` makes of it.

    Args:
        folder: the damaged dataset; it is not changed.
        out: folder of the new one.
        like: the dataset from which LeRobot's tools made `folder`, dropping our metadata: provenance and the
            episodes' metadata are taken from it, joined by episode_uid and values. Or several, of which the
            first gives the provenance. An episode with the uid of one of theirs and other values is left
            out, or, with `new_uids`, has no metadata.
        new_uids: give an episode whose uid an earlier one has a new one, the same in every run, and keep the
            old one as "merged_uid"; otherwise it is left out.

    Raises:
        CorruptDatasetError: meta/info.json is missing, or no episode is intact.
        BadInputError: there is no `folder`, it is a run, `out` exists, or episodes cannot be joined with
            `like`.
    """
    if not folder.is_dir():
        raise BadInputError(f"{folder}: expected the folder of a dataset, got no folder")
    refuse_run(folder)
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
    tasks = read_tasks(folder)
    rows = _recorded_rows(folder, columns, specs, fps)
    if rows:
        specs = our_columns(specs, has_tasks=not isinstance(tasks, str) and len(tasks) > 1)
    result = Repaired(notes=_conversions(info, columns, specs))
    if isinstance(tasks, str):
        result.notes.append(f"{TASKS_PATH} {tasks}: the task is unknown")
        tasks = {}
    # Of what LeRobot's tools made, our metadata is no longer true, where they left it.
    old = _old_description(folder, result.notes) if first is None else {}
    altered = set(_altered_files(folder, old, result.notes))
    digests = _digests(folder, old, columns, result.notes) if first is None else {}
    metadata = _metadata(folder, altered, result.notes) if first is None else {}
    description = _description(folder, info, sources, old)
    unknown = 0
    task = " / ".join(str(tasks[index]) for index in sorted(tasks)) or "unknown"
    seed = _subset_seed(folder, altered) if first is None else first.subset_seed
    whole = partial(whole_runs, folder, columns, digests, fps, repeated=new_uids)
    joined: list[Joined] = []
    if sources or new_uids:
        joined = join(((uid, run.columns) for uid, run in whole([])), specs, sources)
        renamed = sum("merged_uid" in episode.metadata for episode in joined)
        result.notes += [f"{renamed} episodes have new uids, because theirs were taken"] if renamed else []
    recorded: list[Found] = []
    theirs = {uid for source in sources for uid in source.uids.tolist()}
    with DatasetWriter(out, specs, fps=fps, task=task, description=description, subset_seed=seed) as writer:
        for number, (uid, run) in enumerate(whole(result.notes)):
            known = joined[number] if joined else Joined(uid, {}, is_known=False)
            if first is None:
                known = Joined(known.uid, metadata.get(uid, {}) | known.metadata, uid in metadata)
            elif uid in theirs and not known.is_known and not new_uids:
                result.notes.append(
                    f"left out the episode of uid {uid}: its values are not those in "
                    f"{' or '.join(source.reference for source in sources)}"
                )
                continue
            facts = known.metadata
            if rows:
                found = found_in(run, rows, tasks, row=0, uid=uid)
                recorded.append(found)
                if not found.steps:
                    continue
                facts |= found.metadata
            if len(tasks) > 1:
                facts["task"] = tasks.get(int(run.columns[names.TASK_INDEX][0]), "unknown")
            try:
                episode = Episode(known.uid, _values(specs, run, rows, uid), facts)
                writer.add(episode)
            except BadInputError as error:
                result.notes.append(f"left out the episode of uid {uid}: {error}")
                continue
            unknown += not known.is_known
            result.episodes += 1
            result.frames += len(episode)
        if rows and recorded:
            result.notes.append("; ".join(left_out(rows, recorded)))
        counted = info.get("total_episodes")
        if isinstance(counted, int) and counted > result.episodes:
            lost = counted - result.episodes
            result.notes.append(f"{lost} of the {counted} episodes that {INFO_PATH} counts are lost")
        is_all = counted == result.episodes and len(columns) == len(info["features"])
        if is_all and old and old["content_hash"] != writer.content_hash:
            result.notes.append(
                "a value was altered after it was written, because the content hash differs; which one is "
                "unknown"
            )
        if (metadata or sources) and unknown:
            result.notes.append(f"{unknown} episodes have no metadata: they are not among the known ones")
        if len(tasks) > 1:
            result.notes.append(
                f"the {len(tasks)} tasks were merged into one; each episode's own is in its metadata 'task'"
            )
        writer.made = {"repaired": result.notes}
        writer.policy = policy if (policy := folder / POLICY_PATH).is_file() else None
        if not result.episodes:
            raise CorruptDatasetError(f"{folder}: not one whole episode; {'; '.join(result.notes)}")
    return result


def _recorded_rows(
    folder: Path, columns: Sequence[PlainColumn], specs: Sequence[Column], fps: int
) -> Rows | None:
    """Return how rows become ours that LeRobot recorded without next states, None for other datasets."""
    rows = Rows({column.name: column for column in columns}, fps)
    is_ours = names.EPISODE_UID in rows.stored or (folder / OUR_FOLDER).is_dir()
    return None if is_ours or not rows.dropped or lacking(specs) else rows


def _values(specs: Sequence[Column], run: Run, rows: Rows | None, uid: int) -> dict[str, Array]:
    """Return the columns `specs` of an episode; the writer refuses what is too large for its type."""
    if rows:
        return {spec.name: rows.values(spec, run, 0, 0, uid) for spec in specs}
    with np.errstate(over="ignore"):
        return {spec.name: run.columns[spec.name].astype(spec.dtype, copy=False) for spec in specs}


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
    try:
        return read_digests(folder, old.get("sums", {}), [column.name for column in columns]) or {}
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
    return {
        uid: {key: value for key, values in columns.items() if (value := values[row]) is not None}
        for row, uid in enumerate(uids)
    }


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


def _subset_seed(folder: Path, altered: Collection[str]) -> int:
    subsets = "was altered" if SUBSETS_PATH in altered else read_object(folder / SUBSETS_PATH)
    seed = 0 if isinstance(subsets, str) else subsets.get("seed")
    return seed if isinstance(seed, int) else 0
