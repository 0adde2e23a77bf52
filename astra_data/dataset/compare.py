"""Differences between two datasets: columns, episodes, provenance."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.errors import CorruptDatasetError
from astra_data.core.naming import RECORD, printable, shortened
from astra_data.dataset.columns import Column
from astra_data.dataset.description import changed_values, full_name, identity_of, read_description
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import home_of

_DESCRIBED = ("name", "version", "stage", "config", "seeds", "environment", "simulator", "parents")
_SHOWN = 5
"""Entries of a list in the provenance; those of longer ones are counted."""
_Described = tuple[Path, Mapping[str, Any]]
"""Folder and description."""
_Key = tuple[str, str, str]
"""Name, version and content hash."""


@dataclass(frozen=True)
class Differences:
    """How a dataset B differs from a dataset A.

    Attributes:
        schema: one sentence per difference in columns, fps and task.
        only_in_a: uids of episodes that B lacks, ascending.
        only_in_b: uids of episodes that A lacks, ascending.
        values: uids of episodes of both whose values differ, ascending.
        metadata: the keys of metadata that differ, each with the uids of the episodes, ascending.
        description: one sentence per difference in provenance, such as "config.noise_m: 0.1, then 0.2".
    """

    schema: list[str]
    only_in_a: list[int]
    only_in_b: list[int]
    values: list[int]
    metadata: dict[str, list[int]]
    description: list[str]


def differences(a: Dataset, b: Dataset) -> Differences:
    """Compare two datasets; the values of episodes in the columns that both have."""
    shared = sorted({column.name for column in a.schema} & {column.name for column in b.schema})
    prints_a, prints_b = _fingerprints(a, shared), _fingerprints(b, shared)
    both = sorted(prints_a.keys() & prints_b.keys())
    values = [uid for uid in both if prints_a[uid] != prints_b[uid]]
    metadata = {}
    for key in sorted(a.metadata.keys() | b.metadata.keys()):
        ours, theirs = _metadata(a, key), _metadata(b, key)
        if uids := [uid for uid in both if ours.get(uid) != theirs.get(uid)]:
            metadata[key] = uids
    return Differences(
        schema=[*schema_differences(a, b), *_value_differences({"task": a.task}, {"task": b.task})],
        only_in_a=sorted(prints_a.keys() - prints_b.keys()),
        only_in_b=sorted(prints_b.keys() - prints_a.keys()),
        values=values,
        metadata=metadata,
        description=list(_value_differences(_provenance(a), _provenance(b), most=_SHOWN)),
    )


def schema_differences(a: Dataset, b: Dataset) -> list[str]:
    """List how the columns and fps of `b` differ from those of `a`, whatever the order of columns."""
    ours, theirs = ({column.name: column for column in dataset.schema} for dataset in (a, b))
    found = [f"column {name}: only in {a.reference}" for name in ours if name not in theirs]
    found += [f"column {name}: only in {b.reference}" for name in theirs if name not in ours]
    for name in (name for name in ours if name in theirs):
        found += _value_differences(_facts(ours[name]), _facts(theirs[name]), f"column {name}: ")
    return [*found, *_value_differences({"fps": a.info["fps"]}, {"fps": b.info["fps"]})]


def world_differences(a: Dataset, b: Dataset) -> list[str]:
    """List how the environment and the simulator of `b` differ from those of `a`."""
    ours, theirs = (
        {key: dataset.description[key] for key in ("environment", "simulator")} for dataset in (a, b)
    )
    return list(_value_differences(ours, theirs))


def _facts(column: Column) -> dict[str, Any]:
    return {**vars(column), "astra": column.astra or {}}


def _provenance(dataset: Dataset) -> dict[str, Any]:
    return {key: dataset.description[key] for key in _DESCRIBED}


def _value_differences(
    a: Mapping[str, Any], b: Mapping[str, Any], prefix: str = "", *, most: int | None = None
) -> Iterator[str]:
    """Yield a sentence for each difference; of lists with more than `most` entries, these are counted."""

    def is_long(value: object) -> bool:
        return most is not None and isinstance(value, list) and len(value) > most

    def shown(value: Any) -> str:  # noqa: ANN401 - JSON
        return "nothing" if value is None else f"{len(value)} entries" if is_long(value) else repr(value)

    for key, before, after in changed_values(a, b, prefix):
        more = ""
        if is_long(before) and is_long(after):
            known = set(map(repr, before))
            more = f", {sum(repr(entry) not in known for entry in after)} of them new"
        yield f"{key}: {shown(before)}, then {shown(after)}{more}"


def _metadata(dataset: Dataset, key: str) -> dict[int, str]:
    """Return what the episodes that have `key` have there, by uid."""
    values = zip(dataset.uids.tolist(), dataset.metadata.get(key, ()), strict=False)
    return {uid: repr(value) for uid, value in values if value is not None}


def _fingerprints(dataset: Dataset, names: Sequence[str]) -> dict[int, bytes]:
    """Return a digest of each episode's values in the columns `names`, by uid."""
    prints = {}
    for episode in dataset.episodes(names or None):
        print_ = hashlib.sha256()
        for name in names:
            values = episode.columns[name]
            print_.update(f"{name} {values.dtype} {values.shape}".encode() + values.tobytes())
        prints[episode.uid] = print_.digest()
    return prints


@dataclass(frozen=True, eq=False)
class Ancestor:
    """A dataset in the tree; one that several were made from is one object.

    Attributes:
        reference: name and version.
        content_hash: its hash.
        stage: the stage that wrote it, "" if its folder was not found.
        config: the stage's settings, empty if its folder was not found.
        parents: the datasets that it was made from.
        folder: its folder; None if it was not found.
    """

    reference: str
    content_hash: str
    stage: str
    config: Mapping[str, Any]
    parents: tuple["Ancestor", ...]
    folder: Path | None


def lineage(dataset: Dataset) -> Ancestor:
    """Return `dataset` with all its ancestors, looked up in `versions.home()`, beside it, and in its run.

    An ancestor is found where name, version and content hash are those that its descendant lists.
    """
    places = _Places(dataset.root.resolve().parent)
    described: dict[_Key, _Described | None] = {_key(dataset.identity): (dataset.root, dataset.description)}
    known: dict[_Key, Ancestor] = {}
    begun: set[_Key] = set()
    steps = [(_key(dataset.identity), False)]
    while steps:  # without recursion: there may be thousands of versions
        key, is_complete = steps.pop()
        reference = full_name({"name": key[0], "version": key[1]})
        if key in known:
            continue
        if not is_complete and key in begun:
            raise CorruptDatasetError(
                f"{reference} is among its own ancestors: a {DATASET_PATH} was altered; restore it from "
                "a copy."
            )
        if not is_complete and key not in described:
            described[key] = places.find(key)
        folder, description = described[key] or (None, {})
        parents = [_key(parent) for parent in description.get("parents", [])]
        if not is_complete:
            begun.add(key)
            steps += [(key, True), *((parent, False) for parent in parents)]
            continue
        begun.remove(key)
        known[key] = Ancestor(
            reference=reference,
            content_hash=key[2],
            stage=description.get("stage", ""),
            config=description.get("config", {}),
            parents=tuple(known[parent] for parent in parents),
            folder=folder,
        )
    return known[_key(dataset.identity)]


def hashes(ancestor: Ancestor) -> set[str]:
    """Return the content hashes of a dataset and of all its ancestors."""
    return {one.content_hash for one, _, _ in _walked(ancestor)}


def recordings_of(dataset: Dataset) -> NDArray[np.int64]:
    """Return the number of the recording that each episode is, or is a copy of, (E,), from 0 on."""
    sources = dataset.metadata.get("source_episode", [None] * len(dataset))
    numbers: dict[int, int] = {}
    recorded = [uid if source is None else source for uid, source in zip(dataset.uids, sources, strict=True)]
    return np.array([numbers.setdefault(int(uid), len(numbers)) for uid in recorded])


def tree_lines(ancestor: Ancestor) -> Iterator[str]:
    """Yield the tree, a dataset per line, parents indented below their child, those of each dataset once."""
    for one, margin, is_repeated in _walked(ancestor):
        yield margin + _line(one) + ("  (its parents: see above)" if is_repeated and one.parents else "")


def _walked(ancestor: Ancestor) -> Iterator[tuple[Ancestor, str, bool]]:
    """Yield each dataset of a tree, what stands before it in its line, and whether it came before."""
    seen: set[Ancestor] = set()
    steps = [(ancestor, "", "")]
    while steps:
        one, margin, below = steps.pop()
        yield one, margin, one in seen
        if one in seen:
            continue
        seen.add(one)
        for parent in reversed(one.parents):
            is_last = parent is one.parents[-1]
            branch, deeper = ("└── ", "    ") if is_last else ("├── ", "│   ")
            steps.append((parent, below + branch, below + deeper))


class _Places:
    """Where datasets are looked for, each place once."""

    def __init__(self, beside: Path) -> None:
        """Look at home, in the folder `beside` the first dataset, and in the run that it is in."""
        self._beside = beside
        self._neighbors: dict[_Key, _Described] | None = None

    def find(self, key: _Key) -> _Described | None:
        """Return the dataset that has this name, version and hash."""
        found = _described(home_of({"name": key[0], "version": key[1]})).get(key)
        if found is None and self._neighbors is None:
            places = [self._beside.glob(f"*/{DATASET_PATH}")]
            for folder in self._beside.parents[:2]:
                if (folder / RECORD).exists():
                    places += [folder.glob(f"{depth}/{DATASET_PATH}") for depth in ("*/*", "*/*/*")]
            listed = [_described(path.parents[2]) for place in places for path in sorted(place)]
            self._neighbors = {key: found for one in reversed(listed) for key, found in one.items()}
        return found or (self._neighbors or {}).get(key)


def _described(folder: Path) -> dict[_Key, _Described]:
    try:
        found = read_description(folder)
    except CorruptDatasetError:
        return {}
    # A dataset may hold the same values under another name or version.
    return {_key(identity_of(found)): (folder, found)}


def _key(identity: Mapping[str, str]) -> _Key:
    return identity["name"], identity["version"], identity["hash"]


def _line(ancestor: Ancestor) -> str:
    if ancestor.folder is None:
        return f"{ancestor.reference}  {ancestor.content_hash[:8]}  (not found here)"
    settings = ", ".join(
        f"{key} {shortened(str(value), 40)}" for key, value in ancestor.config.items() if value is not None
    )
    line = f"{ancestor.reference}  {ancestor.content_hash[:8]}  {ancestor.stage}"
    return printable(f"{line}: {settings}" if settings else line)


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
