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

RECORDED_TASK = "recorded.task_index"
"""(T,) int64: LeRobot's task_index, where there are several tasks."""
ENDS = (names.TERMINATED, names.TRUNCATED)
FLOATS = (names.STATE, names.NEXT_STATE, names.GOAL, names.ACTION, names.REWARD)
_OUTCOME_FLAGS = (*ENDS, names.DONE, names.SUCCESS)
DERIVED_FLAGS = (
    Column(names.TERMINATED, "bool", meaning="the recording does not tell: never set"),
    Column(names.TRUNCATED, "bool", meaning="the recording of the episode ends"),
    Column(names.DONE, "bool", meaning="terminated or truncated"),
)
DTYPES = {"f": "float32", "i": "int64", "u": "int64", "b": "bool"}
"""Ours, by the kind of the stored values."""


@dataclass(frozen=True)
class Rows:
    """How rows of an episode in the files become rows of ours."""

    stored: Mapping[str, PlainColumn]
    """The columns of numbers in the files."""
    fps: int

    @property
    def dropped(self) -> int:
        """Rows at the end of each episode that are left out: 1 where next states are derived, otherwise 0."""
        return 0 if names.NEXT_STATE in self.stored else 1

    def values(self, spec: Column, run: Run, episode: int, start: int, uid: int) -> Array:
        """Return the column `spec` of one episode, (T,) or (T, size)."""
        steps, name = len(run) - self.dropped, spec.name
        if name in (names.TERMINATED, names.TRUNCATED, names.DONE):
            terminated, truncated = self._ends(run, steps)
            return {names.TERMINATED: terminated, names.TRUNCATED: truncated}.get(name, terminated | truncated)
        if name in names.RESERVED:
            start_of = {"uid": uid, "episode": episode, "start": start}
            values = reserved_values(steps, **start_of, fps=self.fps)[name]
        elif name == names.SUCCESS and self.dropped:
            values = self._successes(run, steps)
        elif name == names.NEXT_STATE and self.dropped:
            values = run.columns[names.STATE][1:]
        else:
            values = run.columns[names.TASK_INDEX if name == RECORDED_TASK else name][:steps]
        if name == names.REWARD and self._hands_on(run):
            values = values.astype(np.float64)
            values[-1] += run.columns[names.REWARD][-1]
        with np.errstate(over="ignore", invalid="ignore"):
            return values.astype(spec.dtype)

    def lost_success(self, run: Run) -> bool:
        """Whether of an episode only the row that is left out succeeded, and no step takes that over."""
        if not self.dropped or names.SUCCESS not in self.stored:
            return False
        successes = run.columns[names.SUCCESS] != 0
        is_handed_on = self._ends_with(names.TERMINATED, run) or self._ends_with(names.DONE, run)
        return bool(successes[-1] and not successes[:-1].any() and not is_handed_on)

    def lost_reward(self, run: Run) -> float:
        """Return the reward of the row that is left out, 0 where the step before takes it over."""
        is_lost = self.dropped and names.REWARD in self.stored and not self._hands_on(run)
        return float(run.columns[names.REWARD][-1]) if is_lost else 0.0

    def is_done_early(self, run: Run) -> bool:
        """Whether `next.done`, of which no end of an episode is made, is set before the last row."""
        return names.DONE in self.stored and bool(run.columns[names.DONE][:-1].any())

    def _ends(self, run: Run, steps: int) -> tuple[Array, Array]:
        """Return terminated and truncated, (T,); an episode that is cut off is truncated.

        If the row that is left out is terminated, the step before it is.
        """
        terminated, truncated = (
            run.columns[name][:steps] != 0 if name in self.stored else np.zeros(steps, bool) for name in ENDS
        )
        terminated[-1] |= self._ends_with(names.TERMINATED, run)
        truncated[-1] |= not terminated[-1]
        return terminated, truncated

    def _successes(self, run: Run, steps: int) -> Array:
        """Return which steps succeeded, (T,).

        The last takes over the success of a row left out that is done; of a terminated one, also its failure.
        """
        stored = run.columns[names.SUCCESS] != 0
        success: Array = stored[:steps].copy()
        if self._ends_with(names.TERMINATED, run):
            success[-1] = stored[-1]
        elif self._ends_with(names.DONE, run):
            success[-1] |= stored[-1]
        return success

    def _hands_on(self, run: Run) -> bool:
        """Whether a row is left out that terminates the episode, whose outcome the step before takes over."""
        return bool(self.dropped) and len(run) > 1 and self._ends_with(names.TERMINATED, run)

    def _ends_with(self, flag: str, run: Run) -> bool:
        """Whether the last row of an episode has this flag, (T,)."""
        return flag in self.stored and bool(run.columns[flag][-1])


@dataclass(frozen=True)
class RecordedFiles:
    """What is known of the files of a recording, and of the E episodes in them that have steps."""

    rows: Rows
    first_rows: Ints
    """The row of the files in which each episode begins, (E,)."""
    total_rows: int
    digests: Digests
    """Those of the values when the recording was opened."""


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
    columns = plain_columns(features)[0] if isinstance(features, dict) else []
    found = {column.name: column for column in columns}
    missing = sorted({c.name for c in DEFAULT_COLUMNS} - found.keys())
    faults = [f"lacks the columns {', '.join(missing)}, which are LeRobot's own"] if missing else []
    if strange := [c.name for c in DEFAULT_COLUMNS if c.name in found and not _fits(found[c.name], c)]:
        faults.append(f"has no single number a step as {', '.join(strange)}")
    if not isinstance(fps, int | float) or not 1 <= fps < MOST_FPS or fps != int(fps):
        faults.append(f"has fps {fps!r}, expected a whole number of frames per second")
    if faults:
        raise CorruptDatasetError(f"{folder}: {INFO_PATH} {' and '.join(faults)}")
    assert isinstance(features, dict) and isinstance(fps, int | float)
    specs = []
    for column in columns:
        if column.name in names.RESERVED:
            continue
        feature = features[column.name]
        known = feature | {
            "dtype": DTYPES[np.dtype(column.dtype).kind],
            "names": _labels(feature.get("names"), column.size),
        }
        specs.append(Column.from_feature(column.name, known))
    return columns, specs, int(fps)


def _fits(stored: PlainColumn, own: Column) -> bool:
    """Return whether a column can be one of LeRobot's own."""
    kinds = "f" if own.dtype == "float32" else "iu"
    return stored.size == 1 and np.dtype(stored.dtype).kind in kinds


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
