"""Datasets that LeRobot recorded or edited itself, read as ours; next states are those of the rows that follow."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.core.naming import first_few
from astra_data.dataset import columns as names
from astra_data.dataset import format as layout
from astra_data.dataset import lerobot_rows, plain
from astra_data.dataset.cameras import Camera, read_cameras
from astra_data.dataset.columns import Column, Scalar
from astra_data.dataset.contents import Contents
from astra_data.dataset.description import ContentHash, Digests, complete_description, digest_of, permutation
from astra_data.dataset.lerobot_rows import RecordedFiles, Rows
from astra_data.dataset.parquet import read_blocks
from astra_data.dataset.statistics import Roundings

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


def open_recording(root: Path) -> Contents:
    """Return the contents of the LeRobot dataset in `root`: check every value, log what is left out."""
    info, tasks = plain.read_object(root / layout.INFO_PATH), plain.read_tasks(root)
    if isinstance(info, str) or isinstance(tasks, str):
        path = layout.INFO_PATH if isinstance(info, str) else layout.TASKS_PATH
        raise CorruptDatasetError(f"{path} {info if isinstance(info, str) else tasks}")
    places, _ = plain.read_places(root, info)
    if lost := plain.missing_files(root, places):
        raise CorruptDatasetError(f"{first_few(lost, MOST_FAULTS)} missing")
    stored, specs, fps = lerobot_rows.declared_columns(root, info)
    if missing := lerobot_rows.lacking(specs):
        raise BadInputError(
            f"{root}, recorded by LeRobot, has no {' and no '.join(missing)}: expected lists of numbers "
            "for the state and the action, and one number for a reward or flag"
        )
    rows = Rows({column.name: column for column in stored}, fps)
    columns = lerobot_rows.our_columns(specs, has_tasks=len(tasks) > 1)
    roundings = Roundings(columns, {column.name: column.dtype for column in stored})
    episodes, content_hash, digests = _survey(root, rows, columns, tasks, info, roundings)
    kept = [episode for episode in episodes if episode.steps]
    if not kept:
        raise BadInputError(f"{root}, recorded by LeRobot, has no episode of two rows or more")
    cameras, unread = read_cameras(root, info)
    others = sorted(info["features"].keys() - {*(spec.name for spec in specs), *names.RESERVED, *cameras, *unread})
    _announce(root, rows, columns, episodes, others, roundings.found(), unread)
    uids, lengths = [episode.uid for episode in kept], np.array([episode.steps for episode in kept])
    positions = {uid: index for index, uid in enumerate(uids)}
    described = {"codebase_version": layout.CODEBASE_VERSION}
    description = {
        "name": lerobot_rows.name_of(root),
        "stage": "record",
        "config": described,
        "environment": lerobot_rows.robot_of(info),
    }
    all_columns, frames = layout.stored_columns(columns), int(lengths.sum())
    return Contents(
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
        cameras={
            name: Camera(
                feature, [clip.part(0, it.steps) for clip, it in zip(clips, episodes, strict=True) if it.steps]
            )
            for name, (feature, clips) in cameras.items()
        },
        recorded=RecordedFiles(
            rows=rows,
            first_rows=np.array([episode.first_row for episode in kept]),
            total_rows=episodes[-1].first_row + episodes[-1].steps + rows.dropped,
            digests=digests,
        ),
    )


def _survey(
    root: Path,
    rows: Rows,
    columns: list[Column],
    tasks: Mapping[int, str],
    info: Mapping[str, Any],
    roundings: Roundings,
) -> tuple[list[Found], str, Digests]:
    """Read every value once, for `roundings`, too; return all episodes, hash and digests of what is ours."""
    stored, specs = list(rows.stored.values()), layout.stored_columns(columns)
    found: list[Found] = []
    faults: list[str] = []
    digests: dict[str, list[int]] = {spec.name: [] for spec in specs}
    content, row, kept, steps = ContentHash(), 0, 0, 0
    tables = read_blocks(plain.data_files(root), [column.name for column in stored])
    for number, run in enumerate(plain.runs(root / "data", tables, stored)):
        faults += [fault for _, fault in plain.run_faults(run, number=number, row=row, fps=rows.fps)]
        flags = {name: run.columns[name] for name in lerobot_rows.ENDS if name in rows.stored}
        faults += plain.flag_faults(flags, f"episode {number} ")
        if len(faults) >= MOST_FAULTS:
            break
        uid = int(run.columns.get(names.EPISODE_UID, run.columns[names.EPISODE_INDEX])[0])
        episode = found_in(run, rows, tasks, row=row, uid=uid)
        found.append(episode)
        row += len(run)
        if not episode.steps:
            continue
        if not faults:
            roundings.add(run.columns)
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
    is_terminated = lerobot_rows.ends_with(names.TERMINATED, run)
    if (success := columns.get(names.SUCCESS)) is not None:
        facts["success"] = bool(success.any())
        is_over = is_terminated or lerobot_rows.ends_with(names.DONE, run)
        lost_success = bool(rows.dropped and success[-1] and not success[:-1].any() and not is_over)
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
    total = sum(episode.steps + rows.dropped for episode in episodes)
    parts = [
        f"next states are those of the following rows, which leaves out the last row of each episode, "
        f"{len(episodes)} of {total} rows"
    ]
    if single := sum(not episode.steps for episode in episodes):
        parts.append(f"{single} of them in episodes of a single row")
    if lost := sum(episode.lost_success for episode in episodes):
        parts.append(
            f"{lost} of these last rows are the only ones that succeeded, so {names.SUCCESS} is lost unless "
            f"{names.DONE} or {names.TERMINATED} is set there"
        )
    if reward := sum(episode.lost_reward for episode in episodes):
        parts.append(f"with the last rows a reward of {reward:g} in sum is left out")
    return parts


def _announce(
    root: Path,
    rows: Rows,
    columns: Sequence[Column],
    episodes: Sequence[Found],
    others: Sequence[str],
    rounded: Sequence[str],
    unread: Mapping[str, str],
) -> None:
    """Say in one line what is left out or rounded, and which ends are not those of episodes."""
    parts = [*left_out(rows, episodes), *rounded]
    if early := [episode.uid for episode in episodes if episode.is_done_early]:
        parts.append(
            f"{names.DONE} is set before the last row of {len(early)} episodes "
            f"({first_few(early, MOST_FAULTS)}), which go on there: an import of the files can end them "
            "(`ends` in [split] of a mapping)"
        )
    for column in columns:
        stored = rows.stored.get(column.name)
        if stored and not np.can_cast(stored.dtype, column.dtype):
            parts.append(f"{column.name} is {column.dtype} here, recorded as {stored.dtype}")
    parts += [f"{camera} is left out: {fault}" for camera, fault in unread.items()]
    if others:
        parts.append(f"left out, because they are not lists of numbers: {', '.join(others)}")
    _log.warning("%s", f"{root}, recorded by LeRobot: {'; '.join(parts) or 'without our metadata'}")
