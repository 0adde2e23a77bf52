"""Join the episodes of a merge by LeRobot's tools, which drop our metadata, with the datasets merged."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from astra_data.dataset.columns import Array, Column, Scalar
from astra_data.dataset.reader import Dataset
from astra_data.dataset.uids import new_uid, renamed_metadata


class Joined(NamedTuple):
    """What is known of an episode.

    Attributes:
        uid: its uid, which differs from the stored one where that was taken.
        metadata: its metadata, with the stored uid as "merged_uid" where it has a new one.
        is_known: whether one of the datasets has it.
    """

    uid: int
    metadata: dict[str, Scalar]
    is_known: bool


def join(
    episodes: Iterable[tuple[int, Mapping[str, Array]]], columns: Sequence[Column], sources: Sequence[Dataset]
) -> list[Joined]:
    """Return the uid and the metadata of each of `episodes`, as the source had it that holds the same values.

    Args:
        episodes: stored uid and columns of each; only the first with a uid keeps it.
        columns: their columns.
        sources: the datasets that were merged, those that are known.
    """
    shared = [c for c in columns if all(c.name in source.features for source in sources)]
    known: dict[tuple[int, bytes], tuple[int | None, Mapping[str, Scalar]]] = {}
    for number, source in enumerate(sources):
        for episode in source.episodes([column.name for column in shared]):
            key = (episode.uid, _digest(episode.columns, shared))
            known.setdefault(key, (number, episode.metadata))
    found = [(uid, _digest(values, shared)) for uid, values in episodes]
    reserved: set[int] = {uid for uid, _ in found}
    taken: set[int] = set()
    renamed: dict[int | None, dict[int, int]] = {}
    names: list[int] = []
    for uid, digest in found:
        name = uid
        if uid in taken:
            name = new_uid(uid, digest, reserved)
            reserved.add(name)
        taken.add(name)
        names.append(name)
        origin = known.get((uid, digest), (None, {}))[0]
        renamed.setdefault(origin, {})[uid] = name
    joined = []
    for (uid, digest), name in zip(found, names, strict=True):
        origin, facts = known.get((uid, digest), (None, {}))
        metadata = renamed_metadata(uid, facts, renamed[origin] | {uid: name})
        joined.append(Joined(name, metadata, (uid, digest) in known))
    return joined


def _digest(values: Mapping[str, Array], columns: Sequence[Column]) -> bytes:
    """Return the sha256 of an episode's values."""
    digest = hashlib.sha256()
    for column in columns:
        digest.update(values[column.name].astype(column.dtype).tobytes())
    return digest.digest()
