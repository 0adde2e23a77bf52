"""Check the values of every episode against the format and against meta/episodes."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.dataset import columns as names
from astra_data.dataset.column_statistics import episode_statistics, side_by_side
from astra_data.dataset.description import ContentHash
from astra_data.dataset.digests import Digests, run_alterations
from astra_data.dataset.doctor.findings import Report
from astra_data.dataset.format import STATISTICS, STATS_PATH, TASKS_PATH
from astra_data.dataset.parquet import read_blocks
from astra_data.dataset.plain import (
    PLAIN_STATISTICS,
    PlainColumn,
    Run,
    data_files,
    episode_rows,
    flag_faults,
    open_end_faults,
    read_statistics,
    read_tasks,
    run_faults,
    runs,
)

EXACT = 1e-6
"""Relative tolerance of our own statistics."""
ESTIMATED = 1e-3
"""Relative tolerance of LeRobot's, which sums in float32."""
_SUMS = 3e-5
"""Error of its means of values and of squares, relative to the largest one; std is their difference."""


class EpisodeChecks:
    """Reads all episodes once, one in memory at a time.

    Attributes:
        hash: the content hash, after `run`.
        uids: uids of the episodes, or their indices without such a column.
        lengths: their numbers of steps.
    """

    def __init__(
        self,
        root: Path,
        info: Mapping[str, Any],
        columns: Sequence[PlainColumn],
        digests: Digests,
        is_ours: bool,
        report: Report,
    ) -> None:
        """Prepare; the stored statistics are exact if the dataset `is_ours`, else estimates.

        The values of all columns, or of none, are compared with `digests`.
        """
        self.hash = ContentHash()
        self.uids: list[int] = []
        self.lengths: list[int] = []
        self._root = root
        self._info = info
        self._columns = columns
        self._digests = digests
        self._is_ours = is_ours
        self._report = report
        self._tasks = self._read_tasks()
        self._total = _Total()

    def run(self) -> None:
        """Check every episode.

        Raises:
            CorruptDatasetError: a file cannot be read.
        """
        every = (
            run
            for path in data_files(self._root)
            for run in runs(path, read_blocks([path], [c.name for c in self._columns]), self._columns)
        )
        for number, (run, row) in enumerate(zip_longest(every, episode_rows(self._root))):
            if run is None:
                self._report.fault("meta/episodes", f"meta/episodes has episode {number}, the data has not")
                continue
            for name, fault in run_faults(run, number=number, row=self._report.frames, fps=self._info["fps"]):
                self._report.fault(name, fault)
            for fault in (*flag_faults(run, number), *open_end_faults(run, number)):
                (self._report.fault if self._is_ours else self._report.note)("flags", fault)
            tasks = np.unique(run.columns[names.TASK_INDEX])
            unknown = [task for task in tasks.tolist() if task not in self._tasks]
            if unknown:
                self._report.fault("tasks", f"episode {number} has the unknown tasks {unknown}")
            for name, values in run.columns.items():
                self.hash.update(name, values)
            for fault in run_alterations(run, number, self._digests):
                self._report.fault("values", fault)
            if row is None:
                self._report.fault("meta/episodes", f"meta/episodes lacks episode {number}")
            else:
                self._check_row(number, run, row)
            self.uids.append(int(run.columns.get(names.EPISODE_UID, [number])[0]))
            self.lengths.append(len(run))
            self._report.episodes += 1
            self._report.frames += len(run)

    def totals(self) -> None:
        """Check counts, uids and, if statistics are estimates, those in stats.json."""
        found = {"total_episodes": self._report.episodes, "total_frames": self._report.frames}
        for key, count in (found | {"total_tasks": len(self._tasks)}).items():
            if self._info.get(key) != count:
                self._report.fault("counts", f"{key} is {self._info.get(key)}, expected {count}")
        first: dict[int, int] = {}
        for number, uid in enumerate(self.uids):
            if first.setdefault(uid, number) != number:
                self._report.fault("uids", f"episodes {first[uid]} and {number} have the same uid {uid}")
        if not self._is_ours:
            self._check_global()

    def _read_tasks(self) -> dict[int, str]:
        tasks = read_tasks(self._root)
        if isinstance(tasks, str):
            self._report.fault("tasks", f"{TASKS_PATH} {tasks}")
            return {}
        return tasks

    def _check_row(self, number: int, run: Run, row: Mapping[str, Any]) -> None:
        start = self._report.frames
        expected: dict[str, object] = {
            "episode_index": number,
            "length": len(run),
            "dataset_from_index": start,
            "dataset_to_index": start + len(run),
        }
        for key, value in expected.items():
            if row.get(key) != value:
                fault = f"meta/episodes: {key} of episode {number} is {row.get(key)}, expected {value}"
                self._report.fault("meta/episodes", fault)
        place = {"chunk_index": row.get("data/chunk_index"), "file_index": row.get("data/file_index")}
        known = all(isinstance(index, int) for index in place.values())
        path = self._info["data_path"].format(**place) if known else None
        if path != str(run.path.relative_to(self._root)):
            fault = f"meta/episodes: the file of episode {number} is {path}, expected {run.path.name}"
            self._report.fault("meta/episodes", fault)
        present = {self._tasks.get(int(task)) for task in np.unique(run.columns[names.TASK_INDEX])}
        listed = row.get("tasks")
        if not isinstance(listed, list) or set(map(str, listed)) != set(map(str, present)):
            fault = f"meta/episodes: tasks of episode {number} are {listed}, expected {present}"
            self._report.fault("meta/episodes", fault)
        self._check_statistics(number, run, row)

    def _check_statistics(self, number: int, run: Run, row: Mapping[str, Any]) -> None:
        table = episode_statistics(run.columns.values())
        found = dict(zip(STATISTICS, table, strict=True))
        self._total.add(found, len(run))
        for kind in STATISTICS if self._is_ours else PLAIN_STATISTICS[:-1]:
            stored = [row.get(f"stats/{column.name}/{kind}") for column in self._columns]
            if _joined(stored, self._columns) == found[kind].tolist():  # to the bit, as most are
                continue
            for (column, part), one in zip(side_by_side(self._columns), stored, strict=True):
                self._compare(kind, f"{column.name} in episode {number}", one, found, part)
        for column in self._columns:
            self._compare_count(
                f"{column.name} in episode {number}", row.get(f"stats/{column.name}/count"), len(run)
            )

    def _check_global(self) -> None:
        stored = read_statistics(self._root)
        if isinstance(stored, str):
            self._report.fault("statistics", f"{STATS_PATH} {stored}")
            return
        found = self._total.statistics()
        for column, part in side_by_side(self._columns) if found else ():
            one = stored.get(column.name, {})
            for kind in PLAIN_STATISTICS[:-1]:
                self._compare(kind, column.name, one.get(kind), found, part)
            self._compare_count(column.name, one.get("count"), self._total.rows)

    def _compare(
        self, kind: str, what: str, stored: object, found: Mapping[str, NDArray[np.float64]], part: slice
    ) -> None:
        expected = found[kind][part]
        largest = np.maximum(np.abs(found["min"][part]), np.abs(found["max"][part]))
        if self._is_ours:
            is_right = is_close(stored, expected, EXACT)
        else:
            is_right = is_estimate(kind, stored, expected, largest)
        if not is_right:
            self._tell(f"{kind} of {what} is {stored}, expected {expected.tolist()}")

    def _compare_count(self, what: str, stored: object, rows: int) -> None:
        if stored != [rows]:
            self._tell(f"count of {what} is {stored}, expected [{rows}]")

    def _tell(self, sentence: str) -> None:
        add = self._report.fault if self._is_ours else self._report.note
        add("statistics", f"statistics: {sentence}")


class _Total:
    """Min, max, mean and std of all rows, from those of the episodes; `rows` is their number."""

    def __init__(self) -> None:
        self.rows = 0
        self._found: dict[str, NDArray[np.float64]] = {}

    def add(self, found: Mapping[str, NDArray[np.float64]], rows: int) -> None:
        """Add an episode."""
        old, count = self._found or found, self.rows + rows
        shift = found["mean"] - old["mean"]
        share = rows / count
        variance = old["std"] ** 2 * (1 - share) + found["std"] ** 2 * share
        self._found = {
            "min": np.minimum(old["min"], found["min"]),
            "max": np.maximum(old["max"], found["max"]),
            "mean": old["mean"] + shift * share,
            "std": np.sqrt(variance + shift**2 * share * (1 - share)),
        }
        self.rows = count

    def statistics(self) -> Mapping[str, NDArray[np.float64]]:
        """Return the statistics of all episodes added, empty if there are none."""
        return self._found


def is_estimate(
    kind: str, stored: object, expected: NDArray[np.float64], largest: NDArray[np.float64]
) -> bool:
    """Return whether LeRobot may have `stored` as this kind of statistic, of values of at most `largest`."""
    try:
        found = np.asarray(stored, dtype=np.float64).ravel()
    except (OverflowError, TypeError, ValueError):
        return False
    if found.size != expected.size:
        return False
    if kind == "std":
        found, expected, largest = found**2, expected**2, largest**2
    error = ESTIMATED * np.abs(expected) + _SUMS * largest
    return bool((np.abs(found - expected) <= error).all())


def _joined(stored: Sequence[object], columns: Sequence[PlainColumn]) -> list[object] | None:
    """Return the lists in `stored` as one, None where one is not of its column's size."""
    joined: list[object] = []
    for one, column in zip(stored, columns, strict=True):
        if not isinstance(one, list) or len(one) != column.size:
            return None
        joined += one
    return joined


def is_close(stored: object, expected: object, tolerance: float) -> bool:
    """Return whether `stored` statistics equal those `expected`, relative to the largest of these."""
    try:
        found, values = (np.asarray(each, dtype=np.float64).ravel() for each in (stored, expected))
    except (OverflowError, TypeError, ValueError):
        return False
    if found.size != values.size:
        return False
    # Most are equal to the bit, and `allclose` takes five times as long.
    if np.array_equal(found, values):
        return True
    return bool(
        np.isfinite(values).all() and np.allclose(found, values, tolerance, tolerance * np.abs(values).max())
    )
