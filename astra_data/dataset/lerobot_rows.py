"""Rows that LeRobot recorded, as those of ours."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.arrays import Ints
from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset import columns as names
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.description import Digests
from astra_data.dataset.format import DEFAULT_COLUMNS, INFO_PATH, reserved_values
from astra_data.dataset.plain import MOST_FPS, PlainColumn, Run, plain_columns

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

    stored: Mapping[str, PlainColumn]  # the columns of numbers in the files
    fps: int

    @property
    def dropped(self) -> int:
        """Rows at the end of each episode that are left out: 1 where next states are derived, otherwise 0."""
        return 0 if names.NEXT_STATE in self.stored else 1

    def values(self, specs: Iterable[Column], run: Run, episode: int, start: int, uid: int) -> dict[str, Array]:
        """Return the columns `specs` of one episode, (T,) or (T, size).

        If the row that is left out is terminated, the step before it is, and has its reward and its success or failure;
        of one that is done, only its success.
        """
        steps, stored = len(run) - self.dropped, run.columns
        found = {name: values[:steps] for name, values in stored.items()}
        found |= reserved_values(steps, uid=uid, episode=episode, start=start, fps=self.fps)
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
        with np.errstate(over="ignore", invalid="ignore"):
            return {spec.name: found[spec.name].astype(spec.dtype) for spec in specs}


def ends_with(flag: str, run: Run) -> bool:
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
    missing = [name for name in (names.STATE, names.ACTION) if name not in sizes]
    return missing + [
        f"{name} of a single number" for name in (names.REWARD, *_OUTCOME_FLAGS) if sizes.get(name, 1) > 1
    ]


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


def declared_columns(folder: Path, info: Mapping[str, Any]) -> tuple[list[PlainColumn], list[Column], int]:
    """Return from info.json the columns of numbers as stored, ours for their values, and the fps."""
    features, fps = info.get("features"), info.get("fps")
    features = features if isinstance(features, dict) else {}
    columns = plain_columns(features)[0]
    found = {column.name: column for column in columns}
    missing = sorted({c.name for c in DEFAULT_COLUMNS} - found.keys())
    faults = [f"lacks the columns {', '.join(missing)}, which are LeRobot's own"] if missing else []
    if strange := [c.name for c in DEFAULT_COLUMNS if c.name in found and not _fits(found[c.name], c)]:
        faults.append(f"has no single number a step as {', '.join(strange)}")
    rate = fps if isinstance(fps, int | float) and 1 <= fps < MOST_FPS and fps == int(fps) else 0
    if not rate:
        faults.append(f"has fps {fps!r}, expected a whole number of frames per second")
    if faults:
        raise CorruptDatasetError(f"{folder}: {INFO_PATH} {' and '.join(faults)}")
    specs = []
    for column in columns:
        if column.name not in names.RESERVED:
            feature = features[column.name]
            labels, kind = _labels(feature.get("names"), column.size), np.dtype(column.dtype).kind
            specs.append(Column.from_feature(column.name, feature | {"dtype": DTYPES[kind], "names": labels}))
    return columns, specs, int(rate)


def _fits(stored: PlainColumn, own: Column) -> bool:
    """Return whether a column can be one of LeRobot's own."""
    return stored.size == 1 and np.dtype(stored.dtype).kind in ("f" if own.dtype == "float32" else "iu")


def name_of(folder: Path) -> str:
    """Return a valid name of a dataset, from that of its folder."""
    name = re.sub(r"[^A-Za-z0-9._-]+|^[^A-Za-z0-9]+", "-", folder.resolve().name)
    return name.lstrip("-._") or "repaired"


def robot_of(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return what info.json says of the robot, as the environment of a dataset of ours."""
    robot = info.get("robot_type")
    return {"robot_type": robot} if isinstance(robot, str) else {}


def _labels(labels: object, size: int) -> list[str] | None:
    """Return a name per value, where `labels` has them: as a list, alone in an object or in another list."""
    while isinstance(labels, dict | list) and len(labels) == 1:
        [inner] = labels.values() if isinstance(labels, dict) else labels
        if not isinstance(inner, dict | list):
            break
        labels = inner
    fits = isinstance(labels, list) and [type(label) for label in labels] == [str] * size
    return list(labels) if fits and isinstance(labels, list) else None
