"""Check a LeRobot dataset, ours or another tool's, and report every fault."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.durable import file_digest
from astra_data.core.errors import AstraDataError, BadInputError, CorruptDatasetError
from astra_data.dataset import columns as names
from astra_data.dataset import format as layout
from astra_data.dataset import plain
from astra_data.dataset.columns import Column
from astra_data.dataset.description import ContentHash, permutation, read_description, read_subsets
from astra_data.dataset.integrity import SEALED, Digests, altered_files, read_digests, run_alterations
from astra_data.dataset.parquet import read_blocks
from astra_data.dataset.reader import Dataset, format_fault, refuse_run, refuse_versions
from astra_data.dataset.statistics import episode_statistics, global_statistics, side_by_side

_META_FILES = (*SEALED, layout.DATASET_PATH, layout.POLICY_PATH)
MOST = 5
"""Findings of one kind that are kept; further ones are only counted."""
EXACT = 1e-6
"""Relative tolerance of our own statistics."""
ESTIMATED = 1e-3
"""Relative tolerance of LeRobot's, which sums in float32."""
_SUMS = 3e-5
"""Error of its means of values and of squares, relative to the largest one; std is their difference."""


class _Findings:
    """Sentences by kind, the first `MOST` of each, and the number of all."""

    def __init__(self) -> None:
        self.kept: dict[str, list[str]] = {}
        self.counts: Counter[str] = Counter()

    def add(self, kind: str, sentence: str) -> None:
        self.counts[kind] += 1
        if self.counts[kind] <= MOST:
            self.kept.setdefault(kind, []).append(sentence)

    def sentences(self) -> list[str]:
        found: list[str] = []
        for kind, sentences in self.kept.items():
            found += sentences
            if more := self.counts[kind] - len(sentences):
                found.append(f"{kind}: and {more} more of this kind")
        return found


@dataclass
class Report:
    """The findings in a dataset.

    Attributes:
        episodes: number of episodes in the data.
        frames: number of steps.
    """

    episodes: int = 0
    frames: int = 0
    _faults: _Findings = field(default_factory=_Findings)
    _notes: _Findings = field(default_factory=_Findings)

    def fault(self, kind: str, sentence: str) -> None:
        """Add a fault."""
        self._faults.add(kind, sentence)

    def note(self, kind: str, sentence: str) -> None:
        """Add something worth knowing that is not a fault."""
        self._notes.add(kind, sentence)

    @property
    def faults(self) -> list[str]:
        """The faults, a sentence each."""
        return self._faults.sentences()

    @property
    def fault_count(self) -> int:
        """The number of faults, including those that `faults` only counts."""
        return self._faults.counts.total()

    @property
    def notes(self) -> list[str]:
        """The notes, a sentence each."""
        return self._notes.sentences()


def check(root: Path) -> Report:
    """Check the dataset in folder `root`: its files, every value and, if it is ours, its provenance.

    Raises:
        BadInputError: there is no folder `root`, or it holds no dataset, or versions of one.
    """
    if not (root / "meta").is_dir() and not (root / "data").is_dir():
        refuse_versions(root)
        refuse_run(root)
        raise BadInputError(f"{root}: found no dataset; expected a folder with meta/ and data/")
    report = Report()
    if fault := format_fault(root):
        report.fault(layout.INFO_PATH, fault)
        return report
    info = plain.read_object(root / layout.INFO_PATH)
    if isinstance(info, str):
        report.fault(layout.INFO_PATH, f"{layout.INFO_PATH} {info}: nothing else was checked")
        return report
    is_ours = (root / layout.DATASET_PATH).exists()
    if not is_ours and any((root / layout.DATASET_PATH).parent.glob("*")):
        report.fault("origin", f"{layout.DATASET_PATH} is missing: the dataset is incomplete; copy it again")
    elif not is_ours:
        report.note("origin", f"no {layout.DATASET_PATH}: a plain LeRobot dataset of unknown provenance")
    columns = _info_faults(info, report)
    if columns and _files_are_readable(root, info, columns, report):
        description = _description(root, report) if is_ours else {}
        digests = _digests(root, description, columns, report) if is_ours else {}
        checks = EpisodeChecks(root, info, columns, digests, is_ours, report)
        try:
            checks.run()
            checks.totals()
            if not report.frames:
                report.fault("values", "there are no steps")
            elif is_ours:
                _global_statistics(root, columns, report)
                _astra_faults(root, description, checks, report)
        except AstraDataError as error:
            report.fault("values", str(error))
    if is_ours and not report.faults:
        try:
            Dataset.open(root)
        except AstraDataError as error:
            report.fault("opening", str(error))
    return report


def _info_faults(info: Mapping[str, Any], report: Report) -> list[plain.PlainColumn]:
    """Check meta/info.json; return the columns whose values can be checked, none if some are missing."""
    version, fps, features = info.get("codebase_version"), info.get("fps"), info.get("features")
    if version != layout.CODEBASE_VERSION:
        report.fault(
            layout.INFO_PATH,
            f"{layout.INFO_PATH}: the format is {version}, expected {layout.CODEBASE_VERSION}",
        )
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < plain.MOST_FPS:
        report.fault(
            layout.INFO_PATH, f"{layout.INFO_PATH}: fps is {fps!r}, expected a positive number below 2^31"
        )
        return []
    if not isinstance(features, dict):
        report.fault(layout.INFO_PATH, f"{layout.INFO_PATH}: features is {features!r}, expected an object")
        return []
    if not plain.is_data_path(data_path := info.get("data_path")):
        expected = f"expected a path inside the folder such as {layout.DATA_PATH}"
        report.fault(layout.INFO_PATH, f"{layout.INFO_PATH}: data_path is {data_path!r}, {expected}")
        return []
    columns, others = plain.plain_columns(features)
    if others:
        report.note("features", f"not checked, because they are not numeric: {', '.join(others)}")
    for column in columns:
        labels = features[column.name].get("names")
        if isinstance(labels, list) and len(labels) != column.size:
            report.fault("names", f"{column.name}: {len(labels)} names for {column.size} values")
        if "/" in column.name:
            report.fault("names", f"{column.name}: a column's name must not contain '/'")
    declared = {column.name: column for column in columns}
    for default in layout.DEFAULT_COLUMNS:
        found = declared.get(default.name)
        if found is None or (found.dtype, found.size) != (default.dtype, default.size):
            report.fault("features", f"{default.name}: expected in features as one {default.dtype} per step")
            columns = []
    return columns


def _files_are_readable(
    root: Path, info: Mapping[str, Any], columns: list[plain.PlainColumn], report: Report
) -> bool:
    """Check which files there are, the footers of all parquet files, and their schemas."""
    _strangers(root, report)
    before, rows = report.fault_count, 0
    for kind, files in (("data", plain.data_files(root)), ("meta/episodes", plain.episodes_files(root))):
        if not files:
            report.fault("files", f"{kind} has no parquet file")
        for path in files:
            name = path.relative_to(root)
            footer = plain.read_footer(path)
            if isinstance(footer, str):
                report.fault("files", f"{name} {footer}")
            elif kind == "data":
                rows += footer[0]
                schema = footer[1]
                unknown = sorted(set(schema.names) - info["features"].keys())
                faults = plain.schema_faults(schema, columns)
                for fault in [*faults, *(f"has an unknown column {column}" for column in unknown)]:
                    report.fault("columns", f"{name} {fault}")
            else:
                for fault in plain.statistics_faults(footer[1], columns, info["features"]):
                    report.note("statistics", f"{name} {fault}")
    if not isinstance(total := info.get("total_frames"), int) or rows < total:
        for missing in plain.missing_files(root, plain.read_places(root, info)[0]):
            report.fault("files", f"{missing} is missing")
    if report.fault_count > before:
        report.note("values", "values were not checked, because not all files could be read as declared")
        return False
    return True


def _strangers(root: Path, report: Report) -> None:
    """Report unknown files: in data/ as faults, in meta/, where other tools may add some, as notes."""
    known = {root / path for path in _META_FILES} | {*plain.data_files(root), *plain.episodes_files(root)}
    for path in sorted([*(root / "data").rglob("*"), *(root / "meta").rglob("*")]):
        if not path.is_dir() and path not in known:
            add = report.fault if path.is_relative_to(root / "data") else report.note
            add("files", f"{path.relative_to(root)} does not belong to it")


def _global_statistics(root: Path, columns: list[plain.PlainColumn], report: Report) -> None:
    stored = plain.read_statistics(root)
    if isinstance(stored, str):
        report.fault(layout.STATS_PATH, f"{layout.STATS_PATH} {stored}")
        return
    ours = [Column(column.name, column.dtype, column.size) for column in columns]
    for name, expected in global_statistics(ours, report.frames, plain.data_files(root)).items():
        for key, values in expected.items():
            found = stored.get(name, {}).get(key)
            if not is_close(found, values, EXACT):
                report.fault(
                    layout.STATS_PATH, f"{layout.STATS_PATH}: {key} of {name} is {found}, expected {values}"
                )


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
        columns: Sequence[plain.PlainColumn],
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
        """Check every episode."""
        every = (
            run
            for path in plain.data_files(self._root)
            for run in plain.runs(path, read_blocks([path], [c.name for c in self._columns]), self._columns)
        )
        for number, (run, row) in enumerate(zip_longest(every, plain.episode_rows(self._root))):
            if run is None:
                self._report.fault("meta/episodes", f"meta/episodes has episode {number}, the data has not")
                continue
            for name, fault in plain.run_faults(
                run, number=number, row=self._report.frames, fps=self._info["fps"]
            ):
                self._report.fault(name, fault)
            for fault in (*plain.flag_faults(run, number), *plain.open_end_faults(run, number)):
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
        tasks = plain.read_tasks(self._root)
        if isinstance(tasks, str):
            self._report.fault("tasks", f"{layout.TASKS_PATH} {tasks}")
            return {}
        return tasks

    def _check_row(self, number: int, run: plain.Run, row: Mapping[str, Any]) -> None:
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

    def _check_statistics(self, number: int, run: plain.Run, row: Mapping[str, Any]) -> None:
        table = episode_statistics(run.columns.values())
        found = dict(zip(layout.STATISTICS, table, strict=True))
        self._total.add(found, len(run))
        for kind in layout.STATISTICS if self._is_ours else plain.PLAIN_STATISTICS[:-1]:
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
        stored = plain.read_statistics(self._root)
        if isinstance(stored, str):
            self._report.fault("statistics", f"{layout.STATS_PATH} {stored}")
            return
        found = self._total.statistics()
        for column, part in side_by_side(self._columns) if found else ():
            one = stored.get(column.name, {})
            for kind in plain.PLAIN_STATISTICS[:-1]:
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


def _astra_faults(root: Path, description: Mapping[str, Any], checks: EpisodeChecks, report: Report) -> None:
    if description and (content := checks.hash.hexdigest()) != (stored := description["content_hash"]):
        report.fault("origin", f"the content hash is {content}, expected {stored}")
    _policy_faults(root, description.get("behavior"), report)
    table = plain.read_small_table(root / layout.METADATA_PATH)
    if isinstance(table, str):
        report.fault(layout.METADATA_PATH, f"{layout.METADATA_PATH} {table}")
    else:
        listed = [(row.get("episode_uid"), row.get("length")) for row in table.to_pylist()]
        present = zip(checks.uids, checks.lengths, strict=True)
        for episode, (found, expected) in enumerate(zip_longest(listed, present)):
            if found != expected:
                fault = f"{found} as uid and length of episode {episode}, expected {expected}"
                report.fault(layout.METADATA_PATH, f"{layout.METADATA_PATH} has {fault}")
    try:
        subsets = read_subsets(root)
        if subsets["uids"] != permutation(checks.uids, subsets["seed"]):
            report.fault(
                layout.SUBSETS_PATH, f"{layout.SUBSETS_PATH}: the uids are not in the order of their seed"
            )
    except CorruptDatasetError as error:
        report.fault(layout.SUBSETS_PATH, str(error))


def _description(root: Path, report: Report) -> Mapping[str, Any]:
    """Return meta/astra/dataset.json, empty if it is malformed; report which sealed files were altered."""
    try:
        description = read_description(root)
    except CorruptDatasetError as error:
        report.fault("origin", str(error))
        return {}
    for path in altered_files(root, description):
        report.fault("sums", f"{path} was altered after it was written, or is missing")
    return description


def _digests(
    root: Path, description: Mapping[str, Any], columns: list[plain.PlainColumn], report: Report
) -> Digests:
    try:
        return read_digests(root, description.get("sums", {}), [column.name for column in columns])
    except CorruptDatasetError as error:
        report.note("digests", f"{error}: it is not known which values were altered, if any")
        return {}


def _policy_faults(root: Path, behavior: object, report: Report) -> None:
    """Compare the stored policy with its recorded checksum, if it was trained while collecting."""
    expected = behavior.get("policy_sha256") if isinstance(behavior, dict) else None
    if expected is None:
        return
    policy = root / layout.POLICY_PATH
    found = file_digest(policy) if policy.is_file() else "not there"
    if found != expected:
        report.fault("origin", f"{layout.POLICY_PATH} is {found}, expected the sha256 {expected}")


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


def _joined(stored: Sequence[object], columns: Sequence[plain.PlainColumn]) -> list[object] | None:
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
