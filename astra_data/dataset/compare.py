"""Differences between two datasets: columns, episodes, provenance."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from astra_data.dataset.columns import Column
from astra_data.dataset.description import changed_values
from astra_data.dataset.reader import Dataset

_DESCRIBED = ("name", "version", "stage", "config", "seeds", "environment", "simulator", "parents")
_SHOWN = 5
"""Entries of a list in the provenance; those of longer ones are counted."""


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
        description=list(_value_differences(_described(a), _described(b), most=_SHOWN)),
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


def _described(dataset: Dataset) -> dict[str, Any]:
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
