"""Save the intact episodes of a damaged LeRobot dataset, ours or another tool's, into a new one."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import columns as names
from astra_data.dataset import format as layout
from astra_data.dataset import lerobot_recording as lerobot
from astra_data.dataset.cameras import Camera, altered_videos, clip_fault, clips_of_runs, encoded_again, read_cameras
from astra_data.dataset.columns import Array, Column, Episode, Scalar, distinct_uids, renamed_metadata
from astra_data.dataset.description import Digests, altered_files, read_description, read_digests
from astra_data.dataset.doctor.salvage import whole_runs
from astra_data.dataset.plain import PlainColumn, Run, is_format_2, read_object, read_small_table, read_tasks
from astra_data.dataset.reader import Dataset, refuse_folders
from astra_data.dataset.versions import successor
from astra_data.dataset.writer import DatasetWriter

_LOST = "success, return and the like of the episodes are lost"
_IF_ALTERED = {
    layout.INFO_PATH: "names, units and fps may be wrong",
    layout.TASKS_PATH: "the task may be wrong",
    layout.METADATA_PATH: _LOST,
    layout.SUBSETS_PATH: "the order of the subsets is that of seed 0",
}  # what follows for the new dataset; statistics are rebuilt, and digests have notes of their own


@dataclass
class Repaired:
    """What `repair` saved, and losses and changes, a sentence each."""

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

    `like` are the datasets from which LeRobot's tools made `folder`, dropping our metadata: the episodes' metadata are
    taken from them, joined by episode_uid and values, the provenance from the first. An episode with the uid of one of
    theirs and other values is left out, or, with `new_uids`, has no metadata. With these, an episode whose uid an
    earlier one has gets a new one, the same in every run, and the old one as "merged_uid"; otherwise it is left out.
    Videos that were encoded again are kept.
    """
    if not folder.is_dir():
        raise BadInputError(f"{folder}: expected the folder of a dataset, got no folder")
    refuse_folders(folder)
    sources = [like] if isinstance(like, Dataset) else list(like or ())
    result = Repaired()
    notes = result.notes
    remains = remains_of(folder, sources, notes)
    rows, tasks = remains.rows, remains.tasks
    whole = partial(whole_runs, folder, remains.columns, remains.digests, remains.fps, new_uids)
    joined: list[Joined] = []
    if sources or new_uids:
        stored = [spec for spec in remains.specs if spec.name in {column.name for column in remains.columns}]
        joined = join(((uid, run.columns) for uid, run in whole([])), stored, sources)
        renamed = sum("merged_uid" in episode.metadata for episode in joined)
        notes += [f"{renamed} episodes have new uids, because theirs were taken"] if renamed else []
    unknown = 0
    recorded: list[lerobot.Found] = []
    theirs = {uid for source in sources for uid in source.uids.tolist()}
    of_several = {source.task for source in sources if "task" in source.metadata}  # which name those of all episodes
    task = " / ".join(str(tasks[index]) for index in sorted(tasks)) or "unknown"
    config, old = {"folder": folder.name}, sources[0].description if sources else remains.old
    description = lerobot.description_of(folder, remains.info, "repair", config)
    if old:
        made_from = [other.identity for other in sources[1:]]
        description = successor(old, "episodes", stage="repair", config=config, out=folder, parents=made_from)[0]
    for name, camera in remains.cameras.items() if sources else ():  # LeRobot's tools encode videos again in place
        if again := dict(encoded_again(camera.clips)):
            remains.cameras |= {name: camera._replace(clips={**camera.clips, **again})}
            notes.append(f"{name} of {len(again)} episodes was encoded again: its pictures are not those first written")
    cameras = _seen(folder, remains, whole, notes)
    features = {name: camera.feature for name, camera in cameras.items()}
    known_facts: dict[str, Any] = {"task": task, "description": description, "subset_seed": remains.subset_seed}
    with DatasetWriter(out, remains.specs, fps=remains.fps, cameras=features, **known_facts) as writer:
        for number, (uid, run) in enumerate(whole(notes)):
            known = joined[number] if joined else Joined(uid, {}, is_known=False)
            if not sources:
                facts = remains.metadata.get(uid, {}) | known.metadata
                known = Joined(known.uid, facts, uid in remains.metadata)
            elif uid in theirs and not known.is_known and not new_uids:
                references = " or ".join(source.reference for source in sources)
                notes.append(f"left out the episode of uid {uid}: its values are not those in {references}")
                continue
            named = tasks.get(int(run.columns[names.TASK_INDEX][0]), "unknown")
            own = known.metadata.get("task", named) if named in of_several else named
            if rows:
                found = lerobot.found_in(run, rows, tasks, row=0, uid=uid)
                recorded.append(found)
                if not found.steps:
                    continue
                known.metadata.update(found.metadata)
            if len(tasks) > 1:
                known.metadata["task"] = own
            try:
                values, at = remains.values(run, uid), int(np.median(run.columns[names.EPISODE_INDEX]))
                steps = len(next(iter(values.values())))
                clips = {name: of[at].part(0, steps) for name, (_, of, _) in cameras.items() if at in of}
                unseen = [f"its pictures of {name} are not known" for name in cameras if name not in clips]
                if unseen := unseen + [fault for clip in clips.values() if (fault := clip_fault(clip))]:
                    raise BadInputError("; ".join(unseen))
                episode = Episode(known.uid, values, known.metadata, clips)
                writer.add(episode)
            except (BadInputError, CorruptDatasetError) as error:
                notes.append(f"left out the episode of uid {uid}: {error}")
                continue
            unknown += not known.is_known
            result.episodes += 1
            result.frames += len(episode)
        if rows and recorded:
            notes.append("; ".join(lerobot.left_out(rows, recorded)))
        notes += remains.losses(result.episodes, writer.content_hash)
        if (remains.metadata or sources) and unknown:
            notes.append(f"{unknown} episodes have no metadata: they are not among the known ones")
        if len(tasks) > 1:
            notes.append(f"the {len(tasks)} tasks were merged into one; each episode's own is in its metadata 'task'")
        writer.made = {"repaired": notes}
        writer.policy = policy if (policy := folder / layout.POLICY_PATH).is_file() else None
        if not result.episodes:
            raise CorruptDatasetError(f"{folder}: not one whole episode; {'; '.join(notes)}")
    return result


@dataclass
class Remains:
    """What is known of a damaged dataset before its episodes are read; empty is what cannot be relied on."""

    info: Mapping[str, Any]  # meta/info.json
    columns: Sequence[PlainColumn]  # the columns of numbers in its files
    specs: Sequence[Column]  # those of the new dataset
    fps: int
    tasks: Mapping[int, str]
    cameras: dict[str, Camera]
    rows: lerobot.Rows | None  # how its rows become ours, where LeRobot recorded it without next states; else None
    subset_seed: int
    old: Mapping[str, Any] = field(default_factory=dict)  # its own description
    digests: Digests = field(default_factory=dict)
    metadata: Mapping[int, dict[str, Scalar]] = field(default_factory=dict)  # the episodes' metadata by uid

    def values(self, run: Run, uid: int) -> dict[str, Array]:
        """Return the columns of an episode; the writer refuses what is too large for its type."""
        if self.rows:
            return self.rows.values(self.specs, run, 0, 0, uid)
        return {spec.name: lerobot.cast(spec.name, run.columns[spec.name], spec.dtype) for spec in self.specs}

    def losses(self, episodes: int, content_hash: str) -> Iterator[str]:
        """Say what is not among the episodes saved, and whether their values are those written."""
        counted = self.info.get("total_episodes")
        if isinstance(counted, int) and counted > episodes:
            yield f"{counted - episodes} of the {counted} episodes that {layout.INFO_PATH} counts are lost"
        is_all = counted == episodes and len(self.columns) == len(self.info["features"])
        if is_all and self.old and self.old["content_hash"] != content_hash:
            yield "a value was altered after it was written, because the content hash differs; which one is unknown"


class Joined(NamedTuple):
    """What is known of an episode: its uid, a new one where the stored one was taken, and its metadata."""

    uid: int
    metadata: dict[str, Scalar]
    is_known: bool  # whether one of the datasets has it


def join(
    episodes: Iterable[tuple[int, Mapping[str, Array]]], columns: Sequence[Column], sources: Sequence[Dataset]
) -> list[Joined]:
    """Return uid and metadata of each of `episodes`, as the source had it that holds the same values."""
    shared = [c for c in columns if all(c.name in source.features for source in sources)]
    known: dict[tuple[int, bytes], tuple[int | None, Mapping[str, Scalar]]] = {}
    for number, source in enumerate(sources):
        for episode in source.episodes([column.name for column in shared]):
            known.setdefault((episode.uid, _digest(episode.columns, shared)), (number, episode.metadata))
    found = [(uid, _digest(values, shared)) for uid, values in episodes]
    renames = distinct_uids(found)
    renamed: dict[int | None, dict[int, int]] = {}
    each = [(key[0], name, *known.get(key, (None, {}))) for key, name in zip(found, renames, strict=True)]
    for uid, name, origin, _ in each:
        renamed.setdefault(origin, {})[uid] = name
    return [
        Joined(name, renamed_metadata(uid, facts, renamed[origin] | {uid: name}), origin is not None)
        for uid, name, origin, facts in each
    ]


def _digest(values: Mapping[str, Array], columns: Sequence[Column]) -> bytes:
    digest = hashlib.sha256()
    for column in columns:
        digest.update(values[column.name].astype(column.dtype).tobytes())
    return digest.digest()


def remains_of(folder: Path, sources: Sequence[Dataset], notes: list[str]) -> Remains:
    """Read what `folder` still tells; add to `notes` what is lost or changed."""
    info = read_object(folder / layout.INFO_PATH)
    if isinstance(info, str):
        raise CorruptDatasetError(f"{folder}: {layout.INFO_PATH} {info}; without it columns and fps are unknown")
    info = {**info, "features": lerobot.stored_features(folder, info.get("features"), notes)}
    columns, specs, fps = lerobot.declared_columns(folder, info)
    if sources and names.EPISODE_UID not in info["features"]:
        raise BadInputError(f"{folder} has no column {names.EPISODE_UID}, by which it joins {sources[0].reference}")
    tasks, rows = read_tasks(folder), lerobot.Rows({column.name: column for column in columns}, fps)
    has_ours = (folder / layout.OUR_FOLDER).is_dir()
    had_none = sources and names.NEXT_STATE not in sources[0].features
    is_ours = has_ours or had_none or not rows.dropped or lerobot.lacking(specs)
    if not is_ours:
        specs = lerobot.our_columns(specs, has_tasks=not isinstance(tasks, str) and len(tasks) > 1)
    if is_format_2(folder):
        notes.append(f"LeRobot's format {info['codebase_version']} became {layout.CODEBASE_VERSION}")
    cameras = read_cameras(folder, info)
    if others := sorted(info["features"].keys() - {*rows.stored, *cameras}):
        notes.append(f"left out, because they are not numeric: {', '.join(others)}")
    kinds = {spec.name: spec.dtype for spec in specs}
    for column in columns:
        kind = kinds.get(column.name, lerobot.DTYPES[np.dtype(column.dtype).kind])
        if column.dtype != kind:
            notes.append(f"{column.name} was {column.dtype} and is now {kind}")
    if isinstance(tasks, str):
        notes.append(f"{layout.TASKS_PATH} {tasks}: the task is unknown")
        tasks = {}
    seed = sources[0].subset_seed if sources else 0
    remains = Remains(info, columns, specs, fps, tasks, cameras, None if is_ours else rows, seed)
    if not has_ours or sources:  # of what LeRobot's tools made, our metadata is no longer true, where they left it
        return remains
    try:
        remains.old = read_description(folder)
    except CorruptDatasetError as error:
        if (folder / layout.DATASET_PATH).exists():
            notes.append(f"{error}: the origin is unknown")
    # A missing file is told where it is read.
    altered = [path for path in altered_files(folder, remains.old) if (folder / path).exists()]
    follows = dict(_IF_ALTERED)
    for name, (_, clips, _) in cameras.items() if layout.INFO_PATH in altered else ():
        if clips and {clip.path for clip in clips.values()} == altered_videos(clips.values()):
            follows[layout.INFO_PATH] = f"if LeRobot's tools encoded {name} again, --like ORIGINAL keeps it"
    notes += [f"{path} was altered after it was written: {why}" for path, why in follows.items() if path in altered]
    try:
        remains.digests = read_digests(folder, [column.name for column in columns], altered)
    except CorruptDatasetError as error:
        notes.append(f"{error}: the values were compared with the content hash only, as a whole")
    if layout.METADATA_PATH not in altered:
        remains.metadata = _metadata(folder, notes)
    if layout.SUBSETS_PATH not in altered:
        subsets = read_object(folder / layout.SUBSETS_PATH)
        stored = subsets.get("seed") if isinstance(subsets, dict) else None
        if isinstance(stored, int):
            remains.subset_seed = stored
        else:
            fault = subsets if isinstance(subsets, str) else "has no whole number as its seed"
            notes.append(f"{layout.SUBSETS_PATH} {fault}: {_IF_ALTERED[layout.SUBSETS_PATH]}")
    return remains


def _seen(
    folder: Path, remains: Remains, whole: Callable[[list[str]], Iterable[tuple[int, Run]]], notes: list[str]
) -> dict[str, Camera]:
    """Return the cameras of which pictures are left, of LeRobot's also those that it tells no places of."""
    cameras = {}
    for name, (feature, known, fault) in remains.cameras.items():
        clips = dict(known)
        if fault and not (folder / layout.OUR_FOLDER).is_dir():
            with suppress(CorruptDatasetError, LookupError, TypeError, ValueError):
                clips = dict(clips_of_runs(folder, remains.info, name, (run for _, run in whole([])))) | clips
        if all(map(clip_fault, clips.values())):  # up to the first that can be read
            notes.append(f"{name} is left out: {fault or next(map(clip_fault, clips.values()), 'there is no episode')}")
            continue
        notes += [f"{name}: {fault}"] if fault else []
        cameras[name] = Camera(feature, clips)
    return cameras


def _metadata(folder: Path, notes: list[str]) -> dict[int, dict[str, Scalar]]:
    """Return the episodes' metadata by uid, empty where it cannot be read."""
    table = read_small_table(folder / layout.METADATA_PATH)
    found: dict[int, dict[str, Scalar]] = {}
    for row in [] if isinstance(table, str) else table.to_pylist():
        if isinstance(uid := row.get(names.EPISODE_UID), int):
            found[uid] = {k: v for k, v in row.items() if k not in layout.METADATA_KEYS and v is not None}
    if not found:
        notes.append(f"{layout.METADATA_PATH} {table if isinstance(table, str) else 'has no uids'}: {_LOST}")
    return found
