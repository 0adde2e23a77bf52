"""Check a LeRobot dataset, ours or another tool's, and report every fault."""

import json
import logging
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.durable import file_digest
from astra_data.core.errors import AstraDataError, BadInputError, CorruptDatasetError, optional, unmet
from astra_data.dataset import columns as names
from astra_data.dataset import description as described
from astra_data.dataset import format as layout
from astra_data.dataset import plain
from astra_data.dataset.cameras import clip_fault, read_cameras
from astra_data.dataset.columns import Array
from astra_data.dataset.format import read_blocks
from astra_data.dataset.reader import Dataset, format_fault, refuse_folders
from astra_data.dataset.statistics import episode_statistics, pooled, side_by_side

_META_FILES = (*described.SEALED, layout.DATASET_PATH, layout.POLICY_PATH)
MOST = 5  # findings of one kind that are shown; further ones are only counted
ESTIMATED = 1e-3  # relative tolerance of LeRobot's statistics, which are summed in float32
_SUMS = 3e-5  # error of its means of values and of squares, relative to the largest one; std is their difference
WINDOWS = 32  # number of windows compared with lerobot's, spread evenly over the dataset
OFFSETS = np.array([-2, -1, 0, 1])  # steps of a window, relative to its row


@dataclass
class Report:
    """The findings in a dataset, and its numbers of episodes and steps."""

    episodes: int = 0
    frames: int = 0
    found: dict[bool, dict[str, list[str]]] = field(default_factory=lambda: {True: {}, False: {}})
    """Faults (True) and notes, by their kind."""

    def fault(self, kind: str, sentence: str) -> None:
        """Add a fault."""
        self.found[True].setdefault(kind, []).append(sentence)

    def note(self, kind: str, sentence: str) -> None:
        """Add something worth knowing that is not a fault."""
        self.found[False].setdefault(kind, []).append(sentence)

    @property
    def faults(self) -> list[str]:
        """The faults, a sentence each, the first `MOST` of each kind."""
        return self._first_of_each(True)

    @property
    def notes(self) -> list[str]:
        """The notes, likewise."""
        return self._first_of_each(False)

    @property
    def fault_count(self) -> int:
        """The number of all faults."""
        return sum(map(len, self.found[True].values()))

    def _first_of_each(self, is_fault: bool) -> list[str]:
        shown = []
        for kind, sentences in self.found[is_fault].items():
            more = len(sentences) - MOST
            shown += [*sentences[:MOST], *([f"{kind}: and {more} more of this kind"] if more > 0 else [])]
        return shown


def check(root: Path) -> Report:
    """Check the dataset in folder `root`: its files, every value and, if it is ours, its digests."""
    if not (root / "meta").is_dir() and not (root / "data").is_dir():
        refuse_folders(root)
        raise BadInputError(f"{root}: found no dataset; expected a folder with meta/ and data/")
    report = Report()
    info = plain.read_object(root / layout.INFO_PATH)
    fault = f"{layout.INFO_PATH} {info}: nothing else was checked" if isinstance(info, str) else None
    if (fault := format_fault(root) or fault) or isinstance(info, str):
        report.fault(layout.INFO_PATH, str(fault))
        return report
    is_ours = (root / layout.DATASET_PATH).exists()
    if not is_ours and (root / layout.OUR_FOLDER).is_dir() and any((root / layout.OUR_FOLDER).iterdir()):
        report.fault("origin", f"{layout.DATASET_PATH} is missing: the dataset is incomplete; copy it again")
    elif not is_ours:
        report.note("origin", f"no {layout.DATASET_PATH}: a plain LeRobot dataset of unknown provenance")
    columns = _info_faults(info, report)
    if columns and _files_are_readable(root, info, columns, report):
        digests = _sealed_faults(root, columns, report) if is_ours else {}
        try:
            EpisodeChecks(root, info, columns, digests, report).run()
        except AstraDataError as error:
            report.fault("values", str(error))
    for name, camera in read_cameras(root, info).items():
        if camera.fault:
            report.fault("cameras", f"{name}: {camera.fault}")
            continue
        for number, clip in camera.clips.items():
            if fault := clip_fault(clip):
                report.fault("cameras", f"{name} in episode {number}: {fault}")
    if is_ours and not report.faults:
        try:
            Dataset.open(root)
        except AstraDataError as error:
            report.fault("opening", str(error))
    return report


def _info_faults(info: Mapping[str, Any], report: Report) -> list[plain.PlainColumn]:
    """Check meta/info.json; return the columns whose values can be checked, none if some are missing."""
    version, fps, features, path = (info.get(key) for key in ("codebase_version", "fps", "features", "data_path"))
    is_rate = isinstance(fps, int | float) and not isinstance(fps, bool) and 0 < fps < plain.MOST_FPS
    inside = f"expected a path inside the folder such as {layout.DATA_PATH}"
    checks = {
        f"the format is {version}, expected {layout.CODEBASE_VERSION}": version == layout.CODEBASE_VERSION,
        f"fps is {fps!r}, expected a positive number below 2^31": is_rate,
        f"features is {features!r}, expected an object": isinstance(features, dict),
        f"data_path is {path!r}, {inside}": plain.is_data_path(path),
    }
    listed = features.items() if isinstance(features, dict) else ()
    checks |= {f"{name} is {one!r} in features, expected an object": isinstance(one, dict) for name, one in listed}
    for name, one in listed:
        if isinstance(one, dict) and one.get("dtype") in plain.NUMBERS:
            shape = one.get("shape")
            is_shape = isinstance(shape, list) and all(type(size) is int and size > 0 for size in shape)
            checks[f"{name} has the shape {shape!r}, expected whole numbers"] = is_shape
    for fault in unmet(checks):
        report.fault(layout.INFO_PATH, f"{layout.INFO_PATH}: {fault}")
    if not isinstance(features, dict) or not all(list(checks.values())[1:]):
        return []
    columns, others = plain.plain_columns(features)
    if others := [name for name in others if features[name].get("dtype") not in ("video", "image")]:
        report.note("features", f"not checked, because they are not numeric: {', '.join(others)}")
    for column in columns:
        labels = features[column.name].get("names")
        if isinstance(labels, list) and len(labels) != column.size:
            report.fault("names", f"{column.name}: {len(labels)} names for {column.size} values")
        if "/" in column.name:
            report.fault("names", f"{column.name}: a column's name must not contain '/'")
    declared = {column.name: (column.dtype, column.size) for column in columns}
    for default in layout.DEFAULT_COLUMNS:
        if declared.get(default.name) != (default.dtype, default.size):
            report.fault("features", f"{default.name}: expected in features as one {default.dtype} per step")
            columns = []
    return columns


def _files_are_readable(root: Path, info: Mapping[str, Any], columns: list[plain.PlainColumn], report: Report) -> bool:
    """Check which files there are, the footers of all parquet files, and their schemas."""
    known = {root / path for path in _META_FILES} | {*plain.data_files(root), *plain.episodes_files(root)}
    for path in sorted([*(root / "data").rglob("*"), *(root / "meta").rglob("*")]):
        if not path.is_dir() and path not in known:  # other tools may add files to meta/
            add = report.fault if path.is_relative_to(root / "data") else report.note
            add("files", f"{path.relative_to(root)} does not belong to it")
    before, rows = report.fault_count, 0
    for kind, files in (("data", plain.data_files(root)), ("meta/episodes", plain.episodes_files(root))):
        if not files:
            report.fault("files", f"{kind} has no parquet file")
        for path in files:
            name, footer = path.relative_to(root), plain.read_footer(path)
            if isinstance(footer, str):
                report.fault("files", f"{name} {footer}")
            elif kind == "data":
                rows += footer[0]
                unknown = sorted(set(footer[1].names) - info["features"].keys())
                faults = [f"has an unknown column {column}" for column in unknown]
                for fault in plain.schema_faults(footer[1], columns) + faults:
                    report.fault("columns", f"{name} {fault}")
    if not isinstance(total := info.get("total_frames"), int) or rows < total:
        for missing in plain.missing_files(root, plain.read_places(root, info)[0]):
            report.fault("files", f"{missing} is missing")
    if report.fault_count > before:
        report.note("values", "values were not checked, because not all files could be read as declared")
    return report.fault_count == before


def _sealed_faults(root: Path, columns: list[plain.PlainColumn], report: Report) -> described.Digests:
    """Compare the files of our metadata with what was written; return the digests, empty if unknown."""
    try:
        description = described.read_description(root)
    except CorruptDatasetError as error:
        report.fault("origin", str(error))
        description = {}
    altered = described.altered_files(root, description)
    for path in altered:
        report.fault("sums", f"{path} was altered after it was written, or is missing")
    behavior = description.get("behavior")
    policy = root / layout.POLICY_PATH
    if isinstance(behavior, dict) and (expected := behavior.get("policy_sha256")) is not None:
        found = file_digest(policy) if policy.is_file() else "not there"
        if found != expected:
            report.fault("origin", f"{layout.POLICY_PATH} is {found}, expected the sha256 {expected}")
    try:
        return described.read_digests(root, [column.name for column in columns], altered)
    except CorruptDatasetError as error:
        report.note("digests", f"{error}: it is not known which values were altered, if any")
        return {}


def _every_run(root: Path, columns: Sequence[plain.PlainColumn]) -> Iterator[plain.Run]:
    for path in plain.data_files(root):
        yield from plain.runs(path, read_blocks([path], [column.name for column in columns]), columns)


@dataclass
class EpisodeChecks:
    """Reads all episodes once, one in memory at a time; compares values with `digests` or, without, statistics."""

    root: Path
    info: Mapping[str, Any]
    columns: Sequence[plain.PlainColumn]
    digests: described.Digests
    report: Report
    tasks: Mapping[int, str] = field(default_factory=dict)
    total: dict[str, Floats] = field(default_factory=dict)  # the statistics of all rows so far

    def run(self) -> None:
        """Check every episode, and what is counted over all of them."""
        report, first = self.report, dict[int, int]()
        if isinstance(tasks := plain.read_tasks(self.root), str):
            report.fault("tasks", f"{layout.TASKS_PATH} {tasks}")
        else:
            self.tasks = tasks
        rows = plain.episode_rows(self.root, statistics=not self.digests)
        for number, (run, row) in enumerate(zip_longest(_every_run(self.root, self.columns), rows)):
            if run is None:
                report.fault("meta/episodes", f"meta/episodes has episode {number}, the data has not")
                continue
            self._check_run(number, run)
            if row is None:
                report.fault("meta/episodes", f"meta/episodes lacks episode {number}")
            else:
                self._check_row(number, run, row)
            uid = int(run.columns.get(names.EPISODE_UID, [number])[0])
            if first.setdefault(uid, number) != number:
                report.fault("uids", f"episodes {first[uid]} and {number} have the same uid {uid}")
            report.episodes += 1
            report.frames += len(run)
        counts = {"episodes": report.episodes, "frames": report.frames, "tasks": len(self.tasks)}
        for key, count in counts.items():
            if (found := self.info.get(f"total_{key}")) != count:
                report.fault("counts", f"total_{key} is {found!r}, expected {count}")
        if not report.frames:
            report.fault("values", "there are no steps")
        elif not self.digests:
            stored = plain.read_object(self.root / layout.STATS_PATH)
            if isinstance(stored, str):
                report.fault("statistics", f"{layout.STATS_PATH} {stored}")
            elif self.total:
                of = {name: each for name, each in stored.items() if isinstance(each, dict)}
                self._compare(lambda name, kind: of.get(name, {}).get(kind), self.total, "")

    def _check_run(self, number: int, run: plain.Run) -> None:
        report = self.report
        for name, fault in plain.run_faults(run, number=number, row=report.frames, fps=self.info["fps"]):
            report.fault(name, fault)
        for faults in (plain.flag_faults, plain.open_end_faults):
            for fault in faults(run.columns, f"episode {number} "):
                report.note("flags", fault)
        if unknown := [t for t in np.unique(run.columns[names.TASK_INDEX]).tolist() if t not in self.tasks]:
            report.fault("tasks", f"episode {number} has the unknown tasks {unknown}")
        if altered := described.alteration(run.columns, number, self.digests, run.path, run.row):
            report.fault("values", altered)

    def _check_row(self, number: int, run: plain.Run, row: Mapping[str, Any]) -> None:
        start = self.report.frames
        place = {key: row.get(f"data/{key}") for key in ("chunk_index", "file_index")}
        known = all(isinstance(index, int) for index in place.values())
        present = {self.tasks.get(int(task)) for task in np.unique(run.columns[names.TASK_INDEX])}
        wanted = {"episode_index": number, "length": len(run)}
        wanted |= {"dataset_from_index": start, "dataset_to_index": start + len(run)}
        compared: dict[str, tuple[object, object]] = {key: (row.get(key), value) for key, value in wanted.items()}
        named, listed = self.info["data_path"].format(**place) if known else None, row.get("tasks")
        compared["the file"] = (named, run.path.as_posix().removeprefix(f"{self.root.as_posix()}/"))
        if not isinstance(listed, list) or set(map(str, listed)) != set(map(str, present)):
            compared["tasks"] = (listed, present)
        for key, (found, expected) in compared.items():
            if found != expected:
                fault = f"meta/episodes: {key} of episode {number} is {found!r}, expected {expected!r}"
                self.report.fault("meta/episodes", fault)
        if not self.digests:
            statistics = dict(zip(layout.STATISTICS, episode_statistics(run.columns.values()), strict=True))
            statistics["count"] = np.array([len(run)])
            every = pooled([self.total, statistics] if self.total else [statistics])
            self.total = {kind: np.array(values) for kind, values in every.items()}
            self._compare(lambda name, kind: row.get(f"stats/{name}/{kind}"), statistics, f" in episode {number}")

    def _compare(self, stored: Callable[[str, str], object], found: Mapping[str, Floats], where: str) -> None:
        """Note which statistics, as `stored` has them by column and kind, differ from those of the values."""
        for column, part in side_by_side(self.columns):
            largest = np.maximum(np.abs(found["min"][part]), np.abs(found["max"][part]))
            for kind in plain.PLAIN_STATISTICS:
                one, expected = stored(column.name, kind), found[kind]
                expected = expected if kind == "count" else expected[part]
                if not is_estimate(kind, one, expected, largest):
                    what = f"{kind} of {column.name}{where} is {one}, expected {expected.tolist()}"
                    self.report.note("statistics", f"statistics: {what}")


def is_estimate(kind: str, stored: object, expected: Floats, largest: Floats) -> bool:
    """Return whether LeRobot may have `stored` as this kind of statistic, of values of at most `largest`."""
    try:
        found = np.asarray(stored, dtype=np.float64).ravel()
    except (OverflowError, TypeError, ValueError):
        return False
    if found.size != expected.size or kind == "count":
        return np.array_equal(found, expected)
    if kind == "std":
        found, expected, largest = found**2, expected**2, largest**2
    return bool((np.abs(found - expected) <= ESTIMATED * np.abs(expected) + _SUMS * largest).all())


def compare_with_lerobot(root: Path, report: Report) -> None:
    """Compare windows with those of `LeRobotDataset`, offline and without its cache; lerobot takes 0.8 GB."""
    handlers = list(logging.getLogger().handlers)
    os.environ["HF_HUB_OFFLINE"] = "1"
    optional("lerobot")
    import datasets.config  # noqa: PLC0415 - slow, and only after the environment is set
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: PLC0415

    info = json.loads((root / layout.INFO_PATH).read_text(encoding="utf-8"))
    looked_at = ("observation", names.ACTION)
    columns = [c for c in plain.plain_columns(info["features"])[0] if c.name.startswith(looked_at)]
    deltas = {column.name: (OFFSETS / info["fps"]).tolist() for column in columns}
    cache, usual = tempfile.TemporaryDirectory(), datasets.config.HF_DATASETS_CACHE
    datasets.config.HF_DATASETS_CACHE = Path(cache.name)
    try:
        loaded = LeRobotDataset("local/dataset", root=root, delta_timestamps=deltas, video_backend="pyav")
        if (len(loaded), loaded.num_episodes) != (report.frames, report.episodes):
            found = f"{loaded.num_episodes} episodes, {len(loaded)} frames"
            report.fault("lerobot", f"lerobot sees {found}, not {report.episodes}, {report.frames}")
        for row, expected, padded in _windows(root, columns, report.frames):
            item = loaded[row]
            for name, values in expected.items():
                # Its loader makes float32 of floats alone.
                shown = values.astype(np.float32) if values.dtype.kind == "f" else values
                if not np.array_equal(item[name].numpy().reshape(values.shape), shown):
                    report.fault("lerobot", f"lerobot's window of {name} around row {row} has other values")
                if not np.array_equal(item[f"{name}_is_pad"].numpy(), padded):
                    report.fault("lerobot", f"lerobot's window of {name} around row {row} has other padding")
    except Exception as error:  # noqa: BLE001 - any failure of lerobot is a finding
        report.fault("lerobot", f"lerobot cannot open it: {type(error).__name__}: {error}".split("\n")[0])
    finally:
        datasets.config.HF_DATASETS_CACHE = usual
        cache.cleanup()
        logging.getLogger().handlers[:] = handlers  # those that lerobot adds put a prefix before our messages


def _windows(root: Path, columns: list[plain.PlainColumn], steps: int) -> Iterator[tuple[int, dict[str, Array], Array]]:
    """Yield rows, the windows around them clipped to their episodes, and the mask of clipped steps."""
    wanted = set(np.linspace(0, steps - 1, WINDOWS).astype(int).tolist())
    split = (names.EPISODE_INDEX, names.FRAME_INDEX)
    read = [*columns, *(plain.PlainColumn(name, "int64", 1) for name in split)]
    first = 0
    for run in _every_run(root, read):
        for row in sorted(wanted & set(range(first, first + len(run)))):
            places = row - first + OFFSETS
            inside = np.clip(places, 0, len(run) - 1)
            yield row, {c.name: run.columns[c.name][inside] for c in columns}, places != inside
        first += len(run)
