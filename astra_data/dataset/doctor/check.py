"""Check a LeRobot dataset, ours or another tool's, and report every fault."""

from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any

from astra_data.core.digest import file_digest
from astra_data.core.errors import AstraDataError, BadInputError, CorruptDatasetError
from astra_data.dataset.column_statistics import global_statistics
from astra_data.dataset.columns import Column
from astra_data.dataset.description import permutation
from astra_data.dataset.digests import Digests, read_digests
from astra_data.dataset.doctor.check_episodes import EXACT, EpisodeChecks, is_close
from astra_data.dataset.doctor.findings import Report
from astra_data.dataset.format import (
    CODEBASE_VERSION,
    DATA_PATH,
    DATASET_PATH,
    DEFAULT_COLUMNS,
    INFO_PATH,
    METADATA_PATH,
    POLICY_PATH,
    STATS_PATH,
    SUBSETS_PATH,
)
from astra_data.dataset.meta_files import read_description, read_subsets
from astra_data.dataset.opening import format_fault, refuse_run, refuse_versions
from astra_data.dataset.plain import (
    MOST_FPS,
    PlainColumn,
    data_files,
    episodes_files,
    is_data_path,
    missing_files,
    plain_columns,
    read_footer,
    read_object,
    read_places,
    read_small_table,
    read_statistics,
    schema_faults,
    statistics_faults,
)
from astra_data.dataset.reader import Dataset
from astra_data.dataset.seal import SEALED, altered_files

_META_FILES = (*SEALED, DATASET_PATH, POLICY_PATH)


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
        report.fault(INFO_PATH, fault)
        return report
    info = read_object(root / INFO_PATH)
    if isinstance(info, str):
        report.fault(INFO_PATH, f"{INFO_PATH} {info}: nothing else was checked")
        return report
    is_ours = (root / DATASET_PATH).exists()
    if not is_ours and any((root / DATASET_PATH).parent.glob("*")):
        report.fault("origin", f"{DATASET_PATH} is missing: the dataset is incomplete; copy it again")
    elif not is_ours:
        report.note("origin", f"no {DATASET_PATH}: a plain LeRobot dataset of unknown provenance")
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


def _info_faults(info: Mapping[str, Any], report: Report) -> list[PlainColumn]:
    """Check meta/info.json; return the columns whose values can be checked, none if some are missing."""
    version, fps, features = info.get("codebase_version"), info.get("fps"), info.get("features")
    if version != CODEBASE_VERSION:
        report.fault(INFO_PATH, f"{INFO_PATH}: the format is {version}, expected {CODEBASE_VERSION}")
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < MOST_FPS:
        report.fault(INFO_PATH, f"{INFO_PATH}: fps is {fps!r}, expected a positive number below 2^31")
        return []
    if not isinstance(features, dict):
        report.fault(INFO_PATH, f"{INFO_PATH}: features is {features!r}, expected an object")
        return []
    if not is_data_path(data_path := info.get("data_path")):
        expected = f"expected a path inside the folder such as {DATA_PATH}"
        report.fault(INFO_PATH, f"{INFO_PATH}: data_path is {data_path!r}, {expected}")
        return []
    columns, others = plain_columns(features)
    if others:
        report.note("features", f"not checked, because they are not numeric: {', '.join(others)}")
    for column in columns:
        labels = features[column.name].get("names")
        if isinstance(labels, list) and len(labels) != column.size:
            report.fault("names", f"{column.name}: {len(labels)} names for {column.size} values")
        if "/" in column.name:
            report.fault("names", f"{column.name}: a column's name must not contain '/'")
    declared = {column.name: column for column in columns}
    for default in DEFAULT_COLUMNS:
        found = declared.get(default.name)
        if found is None or (found.dtype, found.size) != (default.dtype, default.size):
            report.fault("features", f"{default.name}: expected in features as one {default.dtype} per step")
            columns = []
    return columns


def _files_are_readable(
    root: Path, info: Mapping[str, Any], columns: list[PlainColumn], report: Report
) -> bool:
    """Check which files there are, the footers of all parquet files, and their schemas."""
    _strangers(root, report)
    before, rows = report.fault_count, 0
    for kind, files in (("data", data_files(root)), ("meta/episodes", episodes_files(root))):
        if not files:
            report.fault("files", f"{kind} has no parquet file")
        for path in files:
            name = path.relative_to(root)
            footer = read_footer(path)
            if isinstance(footer, str):
                report.fault("files", f"{name} {footer}")
            elif kind == "data":
                rows += footer[0]
                schema = footer[1]
                unknown = sorted(set(schema.names) - info["features"].keys())
                faults = schema_faults(schema, columns)
                for fault in [*faults, *(f"has an unknown column {column}" for column in unknown)]:
                    report.fault("columns", f"{name} {fault}")
            else:
                for fault in statistics_faults(footer[1], columns, info["features"]):
                    report.note("statistics", f"{name} {fault}")
    if not isinstance(total := info.get("total_frames"), int) or rows < total:
        for missing in missing_files(root, read_places(root, info)[0]):
            report.fault("files", f"{missing} is missing")
    if report.fault_count > before:
        report.note("values", "values were not checked, because not all files could be read as declared")
        return False
    return True


def _strangers(root: Path, report: Report) -> None:
    """Report unknown files: in data/ as faults, in meta/, where other tools may add some, as notes."""
    known = {root / path for path in _META_FILES} | {*data_files(root), *episodes_files(root)}
    for path in sorted([*(root / "data").rglob("*"), *(root / "meta").rglob("*")]):
        if not path.is_dir() and path not in known:
            add = report.fault if path.is_relative_to(root / "data") else report.note
            add("files", f"{path.relative_to(root)} does not belong to it")


def _global_statistics(root: Path, columns: list[PlainColumn], report: Report) -> None:
    stored = read_statistics(root)
    if isinstance(stored, str):
        report.fault(STATS_PATH, f"{STATS_PATH} {stored}")
        return
    ours = [Column(column.name, column.dtype, column.size) for column in columns]
    for name, expected in global_statistics(ours, report.frames, data_files(root)).items():
        for key, values in expected.items():
            found = stored.get(name, {}).get(key)
            if not is_close(found, values, EXACT):
                report.fault(STATS_PATH, f"{STATS_PATH}: {key} of {name} is {found}, expected {values}")


def _astra_faults(root: Path, description: Mapping[str, Any], checks: EpisodeChecks, report: Report) -> None:
    if description and (content := checks.hash.hexdigest()) != (stored := description["content_hash"]):
        report.fault("origin", f"the content hash is {content}, expected {stored}")
    _policy_faults(root, description.get("behavior"), report)
    table = read_small_table(root / METADATA_PATH)
    if isinstance(table, str):
        report.fault(METADATA_PATH, f"{METADATA_PATH} {table}")
    else:
        listed = [(row.get("episode_uid"), row.get("length")) for row in table.to_pylist()]
        present = zip(checks.uids, checks.lengths, strict=True)
        for episode, (found, expected) in enumerate(zip_longest(listed, present)):
            if found != expected:
                fault = f"{found} as uid and length of episode {episode}, expected {expected}"
                report.fault(METADATA_PATH, f"{METADATA_PATH} has {fault}")
    try:
        subsets = read_subsets(root)
        if subsets["uids"] != permutation(checks.uids, subsets["seed"]):
            report.fault(SUBSETS_PATH, f"{SUBSETS_PATH}: the uids are not in the order of their seed")
    except CorruptDatasetError as error:
        report.fault(SUBSETS_PATH, str(error))


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
    root: Path, description: Mapping[str, Any], columns: list[PlainColumn], report: Report
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
    policy = root / POLICY_PATH
    found = file_digest(policy) if policy.is_file() else "not there"
    if found != expected:
        report.fault("origin", f"{POLICY_PATH} is {found}, expected the sha256 {expected}")
