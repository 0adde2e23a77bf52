"""Datasets that LeRobot recorded or edited itself, read as ours; next states are those of the rows that follow."""

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from astra_data.core.arrays import Ints
from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.core.naming import first_few
from astra_data.dataset import columns as names
from astra_data.dataset import format as layout
from astra_data.dataset import plain
from astra_data.dataset.cameras import Camera, read_cameras
from astra_data.dataset.columns import Array, Column, Scalar
from astra_data.dataset.description import ContentHash, Digests, complete_description, digest_of, permutation
from astra_data.dataset.format import UNREADABLE, open_parquet, read_blocks

RECORDED_TASK = "recorded.task_index"  # (T,) int64: LeRobot's task_index, where there are several tasks
ENDS = (names.TERMINATED, names.TRUNCATED)
FLOATS = (names.STATE, names.NEXT_STATE, names.GOAL, names.ACTION, names.REWARD)
_OUTCOME_FLAGS = (*ENDS, names.DONE, names.SUCCESS)
DERIVED_FLAGS = (
    Column(names.TERMINATED, "bool", meaning="the recording does not tell: never set"),
    Column(names.TRUNCATED, "bool", meaning="the recording of the episode ends"),
    Column(names.DONE, "bool", meaning="terminated or truncated"),
)
DTYPES = {"f": "float32", "i": "int64", "u": "int64", "b": "bool"}  # ours, by the kind of the stored values


@dataclass(frozen=True)
class Rows:
    """How rows of an episode in the files become rows of ours."""

    stored: Mapping[str, plain.PlainColumn]  # the columns of numbers in the files
    fps: int

    @property
    def dropped(self) -> int:
        """Rows at the end of each episode that are left out: 1 where next states are derived, otherwise 0."""
        return 0 if names.NEXT_STATE in self.stored else 1

    def values(self, specs: Iterable[Column], run: plain.Run, episode: int, start: int, uid: int) -> dict[str, Array]:
        """Return the columns `specs` of one episode, (T,) or (T, size).

        If the row that is left out is terminated, the step before it is, and has its reward and its success or failure;
        of one that is done, only its success.
        """
        steps, stored = len(run) - self.dropped, run.columns
        found = {name: values[:steps] for name, values in stored.items()}
        found |= layout.reserved_values(steps, uid=uid, episode=episode, start=start, fps=self.fps)
        found[RECORDED_TASK] = stored[names.TASK_INDEX][:steps]
        is_terminated, is_done = ends_with(names.TERMINATED, run), ends_with(names.DONE, run)
        terminated, truncated = (found[name] != 0 if name in stored else np.zeros(steps, bool) for name in ENDS)
        terminated[-1] |= is_terminated
        truncated[-1] |= not terminated[-1]
        flags = {names.TERMINATED: terminated, names.TRUNCATED: truncated, names.DONE: terminated | truncated}
        if self.dropped:
            found[names.NEXT_STATE] = stored[names.STATE][1:]
            if names.SUCCESS in stored:
                success = stored[names.SUCCESS] != 0
                flags[names.SUCCESS] = success[:steps].copy()
                if is_terminated or (is_done and success[-1]):
                    flags[names.SUCCESS][-1] = success[-1]
            if names.REWARD in stored and is_terminated:
                found[names.REWARD] = found[names.REWARD].astype(np.float64)
                found[names.REWARD][-1] += stored[names.REWARD][-1]
        found |= flags
        return {spec.name: cast(spec.name, found[spec.name], spec.dtype) for spec in specs}


def cast(name: str, values: Array, dtype: str) -> Array:
    """Return `values` in a type of ours; floats that are too large for it become infinite."""
    if values.dtype == np.uint64 and dtype == "int64" and (values >= 2**63).any():
        raise BadInputError(f"{name}: expected whole numbers below 2^63")
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(dtype)


def ends_with(flag: str, run: plain.Run) -> bool:
    """Whether the last row of an episode has this flag, (T,)."""
    return flag in run.columns and bool(run.columns[flag][-1])


@dataclass(frozen=True)
class RecordedFiles:
    """What is known of the files of a recording, and of the E episodes in them that have steps."""

    rows: Rows
    first_rows: Ints  # the row of the files in which each episode begins, (E,)
    total_rows: int
    digests: Digests  # those of the values when the recording was opened


def lacking(recorded: Iterable[Column]) -> list[str]:
    """Say what columns of a recording lack without which its rows do not become ours."""
    sizes = {column.name: column.size for column in recorded}
    singles = (names.REWARD, *_OUTCOME_FLAGS)
    missing = [name for name in (names.STATE, names.ACTION) if name not in sizes]
    return missing + [f"{name} of a single number" for name in singles if sizes.get(name, 1) > 1]


def our_columns(recorded: Iterable[Column], *, has_tasks: bool) -> list[Column]:
    """Return the columns of the dataset, from those of the recording that are not LeRobot's own."""
    kinds = dict.fromkeys(FLOATS, "float32") | dict.fromkeys(_OUTCOME_FLAGS, "bool")
    columns = {c.name: replace(c, dtype=kinds.get(c.name, c.dtype)) for c in recorded}
    derived = [next_state_of(columns[names.STATE]), *DERIVED_FLAGS]
    derived += [Column(RECORDED_TASK, "int64", meaning="the recording's task_index")] if has_tasks else []
    return [*columns.values(), *(column for column in derived if column.name not in columns)]


def next_state_of(state: Column) -> Column:
    """Return the column of next states, which are those of the following rows."""
    return replace(state, name=names.NEXT_STATE, meaning=f"{state.meaning or 'the state'}, one step later")


def stored_features(folder: Path, declared: object, notes: list[str]) -> dict[str, Any]:
    """Return the features `declared` with the types and sizes of the columns in the first file that can be read."""
    features, schema = dict(declared) if isinstance(declared, dict) else {}, pa.schema([])
    for path in plain.data_files(folder):
        with suppress(*UNREADABLE), open_parquet(path) as file:
            schema = file.schema_arrow
            break
    for one in schema:
        is_list = pa.types.is_fixed_size_list(one.type)
        kind, size = (one.type.value_type, one.type.list_size) if is_list else (one.type, 1)
        dtype, feature = {"double": "float64", "float": "float32"}.get(str(kind), str(kind)), features.get(one.name)
        if not (stored := plain.plain_columns({one.name: {"dtype": dtype, "shape": [size]}})[0]):
            continue
        found = dict(feature) if isinstance(feature, dict) else {}
        if plain.plain_columns({one.name: feature})[0] != stored:
            notes.append(f"{one.name} is {size} {dtype}, as stored: {layout.INFO_PATH} has {feature!r:.80}")
            found |= {"dtype": dtype, "shape": [size]}
        try:
            Column.from_feature(one.name, found | {"dtype": "float32", "names": None})
        except BadInputError as error:
            notes.append(f"what {layout.INFO_PATH} says of units and roles is left out: {error}")
            found.pop("astra", None)
        features[one.name] = found
    return features


def declared_columns(folder: Path, info: Mapping[str, Any]) -> tuple[list[plain.PlainColumn], list[Column], int]:
    """Return from info.json the columns of numbers as stored, ours for their values, and the fps."""
    features, fps = info.get("features"), info.get("fps")
    features = features if isinstance(features, dict) else {}
    columns = plain.plain_columns(features)[0]
    missing = sorted({c.name for c in layout.DEFAULT_COLUMNS} - {c.name for c in columns})
    faults = [f"lacks the columns {', '.join(missing)}, which are LeRobot's own"] if missing else []
    kinds = {column.name: "f" if column.dtype == "float32" else "iu" for column in layout.DEFAULT_COLUMNS}
    own = [column for column in columns if column.name in kinds]
    if strange := [c.name for c in own if c.size != 1 or np.dtype(c.dtype).kind not in kinds[c.name]]:
        faults.append(f"has no single number a step as {', '.join(strange)}")
    rate = fps if isinstance(fps, int | float) and 1 <= fps < plain.MOST_FPS and fps == int(fps) else 0
    if not rate:
        faults.append(f"has fps {fps!r}, expected a whole number of frames per second")
    if faults:
        raise CorruptDatasetError(f"{folder}: {layout.INFO_PATH} {' and '.join(faults)}")
    specs = []
    for column in columns:
        if column.name not in names.RESERVED:
            feature = features[column.name]
            labels, kind = _labels(feature.get("names"), column.size), np.dtype(column.dtype).kind
            specs.append(Column.from_feature(column.name, feature | {"dtype": DTYPES[kind], "names": labels}))
    return columns, specs, int(rate)


def description_of(folder: Path, info: Mapping[str, Any], stage: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the description of a dataset without one of ours: a valid name, from its folder's, and its robot."""
    name, robot = re.sub(r"[^A-Za-z0-9._-]+|^[^A-Za-z0-9]+", "-", folder.resolve().name), info.get("robot_type")
    environment = {"robot_type": robot} if isinstance(robot, str) else {}
    return {"name": name.lstrip("-._") or "repaired", "stage": stage, "config": config, "environment": environment}


def _labels(labels: object, size: int) -> list[str] | None:
    """Return a name per value, where `labels` has them: as a list, alone in an object or in another list."""
    while isinstance(labels, dict | list) and len(labels) == 1:
        [inner] = labels.values() if isinstance(labels, dict) else labels
        if not isinstance(inner, dict | list):
            break
        labels = inner
    fits = isinstance(labels, list) and [type(label) for label in labels] == [str] * size
    return list(labels) if fits and isinstance(labels, list) else None


MOST_FAULTS = 8  # faults that a message lists
_log = logging.getLogger(__name__)


class Found(NamedTuple):
    """An episode in the files."""

    uid: int
    first_row: int
    steps: int
    metadata: Mapping[str, Scalar]
    lost_success: bool
    lost_reward: float
    is_done_early: bool


def open_recording(root: Path) -> dict[str, Any]:
    """Return the fields of `Dataset` for the LeRobot dataset in `root`: check every value, log what is left out."""
    info, tasks = plain.read_object(root / layout.INFO_PATH), plain.read_tasks(root)
    if isinstance(info, str) or isinstance(tasks, str):
        path = layout.INFO_PATH if isinstance(info, str) else layout.TASKS_PATH
        raise CorruptDatasetError(f"{path} {info if isinstance(info, str) else tasks}")
    places, _ = plain.read_places(root, info)
    if lost := plain.missing_files(root, places):
        raise CorruptDatasetError(f"{first_few(lost, MOST_FAULTS)} missing")
    stored, specs, fps = declared_columns(root, info)
    if missing := lacking(specs):
        wanted = "expected lists of numbers for the state and the action, and one number for a reward or flag"
        raise BadInputError(f"{root}, recorded by LeRobot, has no {' and no '.join(missing)}: {wanted}")
    rows = Rows({column.name: column for column in stored}, fps)
    columns = our_columns(specs, has_tasks=len(tasks) > 1)
    episodes, content_hash, digests = _survey(root, rows, columns, tasks, info)
    kept = [episode for episode in episodes if episode.steps]
    if not kept:
        raise BadInputError(f"{root}, recorded by LeRobot, has no episode of two rows or more")
    found = read_cameras(root, info)
    in_metadata = [(place.length, place.first_row) for _, place in sorted(places.items())]
    in_data = [(episode.steps + rows.dropped, episode.first_row) for episode in episodes]
    apart = "" if in_metadata == in_data else "meta/episodes has other lengths or first rows than the data"
    faults = {name: camera.fault or apart for name, camera in found.items()}
    shown = [(at, episode.steps) for at, episode in enumerate(episodes) if episode.steps]
    cameras = {
        name: Camera(camera.feature, dict(enumerate(camera.clips[at].part(0, steps) for at, steps in shown)))
        for name, camera in found.items()
        if not faults[name]
    }
    more = [f"{name} is left out: {fault}" for name, fault in faults.items() if fault]
    if others := sorted(info["features"].keys() - {*(spec.name for spec in specs), *names.RESERVED, *found}):
        more.append(f"left out, because they are not lists of numbers: {', '.join(others)}")
    _announce(root, rows, columns, episodes, more)
    uids, lengths = [episode.uid for episode in kept], np.array([episode.steps for episode in kept])
    positions = {uid: index for index, uid in enumerate(uids)}
    description = description_of(root, info, "record", {"codebase_version": layout.CODEBASE_VERSION})
    all_columns, frames = layout.stored_columns(columns), int(lengths.sum())
    return dict(
        root=root,
        info=dict(layout.dataset_info(all_columns, {}, fps=fps, episodes=len(kept), frames=frames)),
        description=complete_description(description) | {"content_hash": content_hash},
        metadata={key: [episode.metadata[key] for episode in kept] for key in kept[0].metadata},
        uids=np.array(uids),
        lengths=lengths,
        order=[positions[uid] for uid in permutation(uids, 0)],
        subset_seed=0,
        task=" / ".join(tasks[index] for index in sorted(tasks)),
        paths=plain.data_files(root),
        file_starts=np.zeros(1, dtype=np.int64),
        cameras=cameras,
        recorded=RecordedFiles(
            rows=rows,
            first_rows=np.array([episode.first_row for episode in kept]),
            total_rows=episodes[-1].first_row + episodes[-1].steps + rows.dropped,
            digests=digests,
        ),
    )


def _survey(
    root: Path, rows: Rows, columns: list[Column], tasks: Mapping[int, str], info: Mapping[str, Any]
) -> tuple[list[Found], str, Digests]:
    """Read every value once; return all episodes, hash and digests of what is ours."""
    stored, specs = list(rows.stored.values()), layout.stored_columns(columns)
    found: list[Found] = []
    faults: list[str] = []
    digests: dict[str, list[int]] = {spec.name: [] for spec in specs}
    content, row, kept, steps = ContentHash(), 0, 0, 0
    tables = read_blocks(plain.data_files(root), [column.name for column in stored])
    for number, run in enumerate(plain.runs(root / "data", tables, stored)):
        faults += [fault for _, fault in plain.run_faults(run, number=number, row=row, fps=rows.fps)]
        flags = {name: run.columns[name] for name in ENDS if name in rows.stored}
        faults += plain.flag_faults(flags, f"episode {number} ")
        if len(faults) >= MOST_FAULTS:
            break
        uid = int(run.columns.get(names.EPISODE_UID, run.columns[names.EPISODE_INDEX])[0])
        episode = found_in(run, rows, tasks, row=row, uid=uid)
        found.append(episode)
        row += len(run)
        if not episode.steps:
            continue
        for name, values in rows.values(specs, run, kept, steps, uid).items():
            content.update(name, values)
            digests[name].append(digest_of(values))
            if values.dtype.kind == "f" and not faults and not np.isfinite(values).all():
                faults.append(f"{name} in episode {number} is too large for {values.dtype}")
        kept, steps = kept + 1, steps + episode.steps
    counted = (info.get("total_episodes"), info.get("total_frames"))
    if not faults and (len(found), row) != counted:
        faults.append(f"{len(found)} episodes of {row} rows, expected {counted[0]} of {counted[1]}")
    if faults:
        raise CorruptDatasetError("; ".join(faults[:MOST_FAULTS]))
    uids = [episode.uid for episode in found]
    if len(set(uids)) < len(uids) or min(uids, default=0) < 0:
        raise BadInputError(
            f"{root}: {len(uids) - len(set(uids))} episodes have the {names.EPISODE_UID} of an earlier one, "
            "as after a merge by LeRobot's tools; new ones are given, with DATASET one of those merged, by "
            f"`astra-data repair {root} --like DATASET --new-uids --out FOLDER`"
        )
    return found, content.hexdigest(), {name: np.array(each, np.uint64) for name, each in digests.items()}


def found_in(run: plain.Run, rows: Rows, tasks: Mapping[int, str], *, row: int, uid: int) -> Found:
    """Return the episode of the rows `run`, which begins in the given row of the files."""
    columns, facts = run.columns, dict[str, Scalar]()
    lost_success, lost_reward = False, 0.0
    is_terminated = ends_with(names.TERMINATED, run)
    if (success := columns.get(names.SUCCESS)) is not None:
        is_over = is_terminated or ends_with(names.DONE, run)
        lost_success = bool(rows.dropped and success[-1] and not success[:-1].any() and not is_over)
        facts["success"] = bool(success.any()) and not lost_success
    if len(tasks) > 1:
        facts["task"] = tasks.get(int(columns[names.TASK_INDEX][0]), "unknown")
    if names.REWARD in columns and rows.dropped and (len(run) == 1 or not is_terminated):
        lost_reward = float(columns[names.REWARD][-1])
    # No end of an episode is made of `next.done`.
    is_done_early = names.DONE in columns and bool(columns[names.DONE][:-1].any())
    return Found(uid, row, len(run) - rows.dropped, facts, lost_success, lost_reward, is_done_early)


def left_out(rows: Rows, episodes: Sequence[Found]) -> list[str]:
    """Say what is left out with the last rows of the episodes."""
    if not rows.dropped:
        return []
    share = f"{len(episodes)} of {sum(episode.steps + rows.dropped for episode in episodes)} rows"
    parts = [f"next states are those of the following rows, which leaves out the last row of each episode, {share}"]
    if single := sum(not episode.steps for episode in episodes):
        parts.append(f"{single} of them in episodes of a single row")
    if lost := sum(episode.lost_success for episode in episodes):
        which = f"so {names.SUCCESS} is lost unless {names.DONE} or {names.TERMINATED} is set there"
        parts.append(f"{lost} of these last rows are the only ones that succeeded, {which}")
    if reward := sum(episode.lost_reward for episode in episodes):
        parts.append(f"with the last rows a reward of {reward:g} in sum is left out")
    return parts


def _announce(root: Path, rows: Rows, columns: Sequence[Column], episodes: Sequence[Found], more: list[str]) -> None:
    """Say in one line what is left out or rounded, and which ends are not those of episodes, and `more`."""
    parts = left_out(rows, episodes)
    if early := [episode.uid for episode in episodes if episode.is_done_early]:
        which = f"{len(early)} episodes ({first_few(early, MOST_FAULTS)})"
        advice = "an import of the files can end them (`ends` in [split] of a mapping)"
        parts.append(f"{names.DONE} is set before the last row of {which}, which go on there: {advice}")
    for column in columns:
        stored = rows.stored.get(column.name)
        if stored and not np.can_cast(stored.dtype, column.dtype):
            parts.append(f"{column.name} is {column.dtype} here, recorded as {stored.dtype}")
    _log.warning("%s", f"{root}, recorded by LeRobot: {'; '.join([*parts, *more]) or 'without our metadata'}")
