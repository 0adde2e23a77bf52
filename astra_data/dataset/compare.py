"""Differences between two datasets: columns, episodes, provenance."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from astra_data.core.errors import CorruptDatasetError
from astra_data.core.naming import RECORD, printable, shortened
from astra_data.dataset.columns import Column
from astra_data.dataset.description import changed_values, digest_of, full_name, identity_of, read_description
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import home_of

_DESCRIBED = ("name", "version", "stage", "config", "seeds", "environment", "simulator", "parents")
_SHOWN = 5  # entries of a list in the provenance; those of longer ones are counted
_Described = tuple[Path, Mapping[str, Any]]  # folder and description
_Key = tuple[str, str, str]  # name, version and content hash
Ancestors = dict[_Key, _Described | None]  # a dataset and its ancestors; None for those of which no folder was found


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
    ours, theirs = (
        {column.name: {**vars(column), "astra": column.astra or {}} for column in dataset.schema} for dataset in (a, b)
    )
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
    for key, before, after in changed_values(a, b, prefix):
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
    return {
        episode.uid: [
            (digest_of(values), values.dtype, values.shape) for name, values in episode.columns.items() if name in names
        ]
        for episode in dataset.episodes(names or None)
    }


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
        found = read_description(folder)
    except CorruptDatasetError:
        return {}
    # A dataset may hold the same values under another name or version.
    return {_key(identity_of(found)): (folder, found)}


def _key(identity: Mapping[str, str]) -> _Key:
    return identity["name"], identity["version"], identity["hash"]


def _line(key: _Key, one: _Described | None) -> str:
    line = f"{full_name({'name': key[0], 'version': key[1]})}  {key[2][:8]}  "
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
