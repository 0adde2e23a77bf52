"""Save the intact episodes of a damaged LeRobot dataset, ours or another tool's, into a new one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import columns as names
from astra_data.dataset.columns import Array, Column, Episode
from astra_data.dataset.doctor.joining import Joined, join
from astra_data.dataset.doctor.remains import Remains, remains_of
from astra_data.dataset.doctor.salvage import whole_runs
from astra_data.dataset.format import INFO_PATH, POLICY_PATH
from astra_data.dataset.lerobot_recording import Found, found_in, left_out
from astra_data.dataset.lerobot_rows import Rows
from astra_data.dataset.opening import refuse_run, refuse_versions
from astra_data.dataset.plain import Run
from astra_data.dataset.reader import Dataset
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

    Episodes with wrong values, with other values than were written, or with rows in a part of a file that
    cannot be read are left out, and all that follow once it is unclear where episodes begin. Data files
    without a footer, which a killed writer leaves, are read page by page. Statistics and meta/episodes are
    rebuilt. What LeRobot recorded without next states becomes what `Dataset.open` makes of it.

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
        BadInputError: there is no `folder`, it is a run or holds versions of a dataset, `out` exists, or
            episodes cannot be joined with `like`.
    """
    if not folder.is_dir():
        raise BadInputError(f"{folder}: expected the folder of a dataset, got no folder")
    refuse_versions(folder)
    refuse_run(folder)
    sources = [like] if isinstance(like, Dataset) else list(like or ())
    result = Repaired()
    remains = remains_of(folder, sources, result.notes)
    rows, tasks = remains.rows, remains.tasks
    whole = partial(whole_runs, folder, remains.columns, remains.digests, remains.fps, repeated=new_uids)
    joined: list[Joined] = []
    if sources or new_uids:
        joined = join(((uid, run.columns) for uid, run in whole([])), remains.specs, sources)
        renamed = sum("merged_uid" in episode.metadata for episode in joined)
        result.notes += [f"{renamed} episodes have new uids, because theirs were taken"] if renamed else []
    unknown = 0
    recorded: list[Found] = []
    theirs = {uid for source in sources for uid in source.uids.tolist()}
    with DatasetWriter(
        out,
        remains.specs,
        fps=remains.fps,
        task=" / ".join(str(tasks[index]) for index in sorted(tasks)) or "unknown",
        description=remains.description,
        subset_seed=remains.subset_seed,
    ) as writer:
        for number, (uid, run) in enumerate(whole(result.notes)):
            known = joined[number] if joined else Joined(uid, {}, is_known=False)
            if not sources:
                facts = remains.metadata.get(uid, {}) | known.metadata
                known = Joined(known.uid, facts, uid in remains.metadata)
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
                episode = Episode(known.uid, _values(remains.specs, run, rows, uid), facts)
                writer.add(episode)
            except BadInputError as error:
                result.notes.append(f"left out the episode of uid {uid}: {error}")
                continue
            unknown += not known.is_known
            result.episodes += 1
            result.frames += len(episode)
        if rows and recorded:
            result.notes.append("; ".join(left_out(rows, recorded)))
        result.notes += _losses(remains, result.episodes, writer.content_hash)
        if (remains.metadata or sources) and unknown:
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


def _values(specs: Sequence[Column], run: Run, rows: Rows | None, uid: int) -> dict[str, Array]:
    """Return the columns `specs` of an episode; the writer refuses what is too large for its type."""
    if rows:
        return {spec.name: rows.values(spec, run, 0, 0, uid) for spec in specs}
    with np.errstate(over="ignore"):
        return {spec.name: run.columns[spec.name].astype(spec.dtype, copy=False) for spec in specs}


def _losses(remains: Remains, episodes: int, content_hash: str) -> Iterator[str]:
    """Say what of the dataset is not among the episodes saved, and whether their values are those written."""
    counted = remains.info.get("total_episodes")
    if isinstance(counted, int) and counted > episodes:
        yield f"{counted - episodes} of the {counted} episodes that {INFO_PATH} counts are lost"
    is_all = counted == episodes and len(remains.columns) == len(remains.info["features"])
    if is_all and remains.old and remains.old["content_hash"] != content_hash:
        yield (
            "a value was altered after it was written, because the content hash differs; which one is unknown"
        )
