"""Versions of datasets, how they are named, `name@data-1.2.0` or by a folder, and how they differ.

Datasets without a folder of their own live at home, which is $ASTRA_DATA_HOME, by default ./datasets:

<home>/<name>/data-<version>/

A version never changes. Of MAJOR.MINOR.PATCH, a change of the columns increments the first number, one of the
episodes the second; the third stays 0.
"""

import logging
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.core.naming import RECORD, printable, shortened
from astra_data.dataset import description as provenance
from astra_data.dataset.columns import Column
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.plain import read_object
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter

_LOG = logging.getLogger(__name__)

Change = Literal["columns", "episodes"]

_REFERENCE = re.compile(rf"(?P<name>{provenance.NAME.pattern})(@(data-)?(?P<version>{provenance.VERSION.pattern}))?")
_DESCRIBED = ("name", "version", "stage", "config", "seeds", "environment", "simulator", "parents")
_SHOWN = 5  # entries of a list in the provenance; those of longer ones are counted
_Described = tuple[Path, Mapping[str, Any]]  # folder and description
_Key = tuple[str, str, str]  # name, version and content hash
Ancestors = dict[_Key, _Described | None]  # a dataset and its ancestors; None for those of which no folder was found


@dataclass(frozen=True, order=True)
class Version:
    """MAJOR.MINOR.PATCH; newer versions are greater."""

    major: int
    minor: int
    patch: int

    @classmethod
    def parse(cls, text: str) -> "Version":
        """Read "1.2.0"."""
        if not provenance.VERSION.fullmatch(text):
            raise BadInputError(f"version '{shortened(text, 80)}': expected three numbers such as 1.2.0")
        return cls(*map(int, text.split(".")))

    @property
    def tag(self) -> str:
        """The name of folders and git tags: "data-1.2.0"."""
        return f"data-{self}"

    @classmethod
    def from_tag(cls, tag: str) -> "Version | None":
        """Read "data-1.2.0"; None if it is no such tag."""
        return cls.parse(tag[5:]) if re.fullmatch(f"data-{provenance.VERSION.pattern}", tag) else None

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}.{self.patch}"

    def next(self, change: Change, taken: Iterable["Version"] = ()) -> "Version":
        """Return the version after `change`, greater than all of `taken` that it could collide with."""
        every = [self, *taken]
        if change == "columns":
            return Version(max(every).major + 1, 0, 0)
        return Version(self.major, max(one.minor for one in every if one.major == self.major) + 1, 0)


def home() -> Path:
    """Return the folder of datasets that have none of their own."""
    folder = Path(os.environ.get("ASTRA_DATA_HOME", "datasets"))
    if folder.exists() and not folder.is_dir():
        raise BadInputError(f"{folder} is no folder: expected that of the datasets; set $ASTRA_DATA_HOME to one")
    return folder


def home_of(description: Mapping[str, Any]) -> Path:
    """Return the folder at home of the dataset with this "name" and "version"."""
    return home() / str(description["name"]) / f"data-{description['version']}"


def names_at_home() -> list[str]:
    """Return the names of the datasets at home."""
    return sorted(folder.name for folder in home().glob("*") if versions_at_home(folder.name))


def versions_at_home(name: str) -> list[Version]:
    """Return the versions of dataset `name` at home, the oldest first."""
    folders = (folder for folder in (home() / name).glob("data-*") if folder.is_dir())
    return sorted(version for folder in folders if (version := Version.from_tag(folder.name)))


def locate(dataset: str | Path) -> Path:
    """Return the folder of `dataset`: one, `name@data-1.2.0`, or `name` for its highest version at home."""
    reference, folder = _REFERENCE.fullmatch(str(dataset)), Path(dataset)
    with suppress(OSError):  # its name may be too long for a file
        # A folder without a dataset or versions of one, such as that of `new`, does not hide a name.
        holds = (folder / "meta").is_dir() or any(folder.glob("data-*.*.*"))
        if folder.is_dir() and (holds or not reference or not versions_at_home(reference["name"])):
            return folder
    if not reference:
        raise BadInputError(f"{str(dataset)[:300]}: no such folder; expected a folder, name or name@data-1.2.0")
    name, version = reference["name"], reference["version"]
    versions = versions_at_home(name)
    if not versions:
        raise BadInputError(f"no dataset '{name}' in {home()}{did_you_mean(name, names_at_home())}")
    if version and Version.parse(version) not in versions:
        known = ", ".join(f"data-{known}" for known in versions)
        raise BadInputError(f"{name} has no version data-{version} in {home()}; it has {known}")
    folder = home_of({"name": name, "version": version or versions[-1]})
    made = read_object(folder / DATASET_PATH) if version is None and len(versions) > 1 else {}
    if isinstance(made, dict) and made.get("stage") == "subset":
        known = ", ".join(f"{name}@{known.tag}" for known in versions[:-1])
        _LOG.warning("%s is %s@%s here, a subset; the others are %s", name, name, versions[-1].tag, known)
    return folder


def open_dataset(dataset: str | Path) -> Dataset:
    """Open `dataset`, named as `locate` takes it; it raises as `Dataset.open` does."""
    return Dataset.open(locate(dataset))


def successor(
    source: Mapping[str, Any],
    change: Change,
    *,
    stage: str,
    config: Mapping[str, Any],
    name: str | None = None,
    out: Path | None = None,
    parents: Iterable[Mapping[str, str]] = (),
    **more: Any,
) -> tuple[dict[str, Any], Path]:
    """Return the description of the version that follows the description `source` by a `change`, and its folder.

    Name, seeds, environment and simulator are carried over, but for those in `more`; with another `name`, a new dataset
    begins with version 1.0.0. With `out`, the version does not depend on those at home.
    """
    kept = {key: source[key] for key in ("seeds", "environment", "simulator")}
    name = source["name"] if name is None else name
    taken = versions_at_home(name) if out is None else []
    before = Version.parse(source["version"]) if name == source["name"] else max(taken, default=None)
    version = before.next(change, taken) if before else Version(1, 0, 0)
    identities = [provenance.identity_of(source), *parents]
    made = {"name": name, "version": str(version), "stage": stage, "config": dict(config), "parents": identities}
    description = {**made, **kept, **more}
    return description, home_of(description) if out is None else out


def next_version(
    source: Dataset,
    change: Change,
    *,
    more: Sequence[Column] = (),
    cameras: bool = True,
    schema: Sequence[Column] | None = None,
    fps: int | None = None,
    subset_seed: int | None = None,
    task: str | None = None,
    **described: Any,
) -> DatasetWriter:
    """Prepare to write the version that follows `source`; its folder is the writer's `root`.

    Columns (or those of `schema`), of which there may be `more`, `cameras` unless False, `fps`, task, the seed of the
    subsets and the description are carried over; `described` is what `successor` takes: `stage`, `config`, `name`, ...
    """
    description, folder = successor(source.description, change, **described)
    return DatasetWriter(
        folder,
        [*(source.schema if schema is None else schema), *more],
        fps=fps or source.info["fps"],
        task=source.task if task is None else task,
        description=description,
        subset_seed=source.subset_seed if subset_seed is None else subset_seed,
        cameras={name: camera.feature for name, camera in source.cameras.items()} if cameras else {},
    )


@dataclass(frozen=True)
class Differences:
    """How a dataset B differs from a dataset A: sentences, and uids of episodes, ascending."""

    schema: list[str]  # columns, fps and task
    only_in_a: list[int]
    only_in_b: list[int]
    values: list[int]  # episodes of both whose values differ
    metadata: dict[str, list[int]]  # the keys that differ, each with the episodes
    description: list[str]  # provenance, such as "config.noise_m: 0.1, then 0.2"


def differences(a: Dataset, b: Dataset) -> Differences:
    """Compare two datasets; the values of episodes in the columns that both have."""
    shared = sorted({column.name for column in a.schema} & {column.name for column in b.schema})
    prints_a, prints_b = _fingerprints(a, shared), _fingerprints(b, shared)
    both = sorted(prints_a.keys() & prints_b.keys())
    metadata = {}
    for key in sorted(a.metadata.keys() | b.metadata.keys()):
        ours, theirs = (
            {u: repr(v) for u, v in zip(d.uids, d.metadata.get(key, [None] * len(d)), strict=True)} for d in (a, b)
        )
        if uids := [uid for uid in both if ours[uid] != theirs[uid]]:
            metadata[key] = uids
    before, after = ({key: dataset.description[key] for key in _DESCRIBED} for dataset in (a, b))
    return Differences(
        schema=[*schema_differences(a, b), *_value_differences({"task": a.task}, {"task": b.task})],
        only_in_a=sorted(prints_a.keys() - prints_b.keys()),
        only_in_b=sorted(prints_b.keys() - prints_a.keys()),
        values=[uid for uid in both if prints_a[uid] != prints_b[uid]],
        metadata=metadata,
        description=list(_value_differences(before, after, most=_SHOWN)),
    )


def schema_differences(a: Dataset, b: Dataset, described: Sequence[str] = ()) -> list[str]:
    """List how columns, fps and the parts `described` of `b` differ from those of `a`, whatever the columns' order."""
    ours, theirs = ({c.name: {**vars(c), "astra": c.astra or {}} for c in dataset.schema} for dataset in (a, b))
    found = [f"column {name}: only in {a.reference}" for name in ours if name not in theirs]
    found += [f"column {name}: only in {b.reference}" for name in theirs if name not in ours]
    for name in (name for name in ours if name in theirs):
        found += _value_differences(ours[name], theirs[name], f"column {name}: ")
    seen, other = ({name: [it.feature["dtype"], it.feature["shape"]] for name, it in d.cameras.items()} for d in (a, b))
    found += _value_differences(seen, other, "camera ")
    ours, theirs = ({"fps": d.info["fps"]} | {key: d.description[key] for key in described} for d in (a, b))
    return [*found, *_value_differences(ours, theirs)]


def _value_differences(
    a: Mapping[str, Any], b: Mapping[str, Any], prefix: str = "", *, most: int | None = None
) -> Iterator[str]:
    """Yield a sentence for each difference; of lists with more than `most` entries, these are counted."""
    for key, before, after in provenance.changed_values(a, b, prefix):
        long = [value for value in (before, after) if most and isinstance(value, list) and len(value) > most]
        shown = [
            "nothing" if value is None else f"{len(value)} entries" if value in long else repr(value)
            for value in (before, after)
        ]
        more = ""
        if len(long) == 2:
            known = set(map(repr, before))
            more = f", {sum(repr(entry) not in known for entry in after)} of them new"
        yield f"{key}: {shown[0]}, then {shown[1]}{more}"


def _fingerprints(dataset: Dataset, names: Sequence[str]) -> dict[int, list[object]]:
    """Return what tells each episode's values in the columns `names` from others, by uid."""
    found: dict[int, list[object]] = {}
    for episode in dataset.episodes(names or None):
        columns = [episode.columns[name] for name in names]
        found[episode.uid] = [(provenance.digest_of(one), one.dtype, one.shape) for one in columns]
    return found


def lineage(dataset: Dataset) -> Ancestors:
    """Return `dataset` and its ancestors, by name, version and hash, at home, beside it, and in its run."""
    root = dataset.root.resolve()

    @cache
    def neighbors() -> Ancestors:
        folders = sorted(root.parent.glob(f"*/{DATASET_PATH}"))
        for run in (run for run in root.parents[1:3] if (run / RECORD).exists()):
            folders += [path for depth in ("*/*", "*/*/*") for path in sorted(run.glob(f"{depth}/{DATASET_PATH}"))]
        return {key: found for path in reversed(folders) for key, found in _described(path.parents[2]).items()}

    todo = [_key(dataset.identity)]
    found: Ancestors = {todo[0]: (dataset.root, dataset.description)}
    todo = _parents(found[todo[0]])
    while todo:
        key = todo.pop()
        if key not in found:
            at_home = _described(home_of({"name": key[0], "version": key[1]}))
            found[key] = at_home.get(key) or neighbors().get(key)
            todo += _parents(found[key])
    return found


def tree_lines(ancestors: Ancestors) -> Iterator[str]:
    """Yield the tree, a dataset per line, parents indented below their child, those of each dataset once."""
    seen: set[_Key] = set()
    steps = [(next(iter(ancestors)), "", "")]
    while steps:  # without recursion: there may be thousands of versions
        key, margin, below = steps.pop()
        parents = _parents(ancestors[key])
        yield (margin + _line(key, ancestors[key]) + ("  (its parents: see above)" if key in seen and parents else ""))
        if key in seen:
            continue
        seen.add(key)
        for number in reversed(range(len(parents))):
            branch, deeper = ("└── ", "    ") if number == len(parents) - 1 else ("├── ", "│   ")
            steps.append((parents[number], below + branch, below + deeper))


def _parents(one: _Described | None) -> list[_Key]:
    return [_key(parent) for parent in one[1]["parents"]] if one else []


def _described(folder: Path) -> Ancestors:
    try:
        found = provenance.read_description(folder)
    except CorruptDatasetError:
        return {}
    # A dataset may hold the same values under another name or version.
    return {_key(provenance.identity_of(found)): (folder, found)}


def _key(identity: Mapping[str, str]) -> _Key:
    return identity["name"], identity["version"], identity["hash"]


def _line(key: _Key, one: _Described | None) -> str:
    line = f"{provenance.full_name({'name': key[0], 'version': key[1]})}  {key[2][:8]}  "
    if one is None:
        return f"{line}(not found here)"
    config = one[1]["config"].items()
    settings = ", ".join(f"{name} {shortened(str(value), 40)}" for name, value in config if value is not None)
    return printable(f"{line}{one[1]['stage']}" + (f": {settings}" if settings else ""))


def column_faults(source: Dataset, expected: Column, task: str) -> list[str]:
    """List how a column of a dataset is of another size, in another order or in other units than a task's."""
    if expected.name not in source.features:
        return [f"has no column {expected.name}"]
    recorded = Column.from_feature(expected.name, source.features[expected.name])
    if recorded.size != expected.size:
        return [f"{expected.name} has {recorded.size} values, expected those of {task}: {expected.size}"]
    faults, names = [], recorded.names or ()
    if any(name in names and names.index(name) != place for place, name in enumerate(expected.names or ())):
        order = ", ".join(expected.labels)
        faults.append(f"has the values {', '.join(names)} in {expected.name}, expected the order {order}")
    for name, own, other in zip(recorded.labels, recorded.units, expected.units, strict=True):
        if own and other and own != other:
            faults.append(f"has {name} of {expected.name} in {own}, expected {other}: scale it on import")
    return faults


def names_apart(source: Dataset, expected: Iterable[Column], task: str) -> str:
    """Say which columns of a dataset, where they fit, have no name that the task has; empty if none."""
    apart = []
    for column in expected:
        recorded = Column.from_feature(column.name, source.features[column.name])
        if column.names and not {*(recorded.names or ())} & {*column.names}:
            given = ", ".join(recorded.names or ["values without names"])
            apart.append(f"{given} of {column.name} as {', '.join(column.names)}")
    if not apart:
        return ""
    return f"{source.reference}: takes {' and '.join(apart)} of {task}: check that they are, in this order"
