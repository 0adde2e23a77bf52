"""Uids of episodes that meet others of the same uid."""

import hashlib
from collections.abc import Collection, Mapping
from typing import Any

from astra_data.dataset.columns import Scalar


def new_uid(uid: int, origin: bytes, known: Collection[int]) -> int:
    """Return a uid that is not among those `known`, always the same for `uid` of this `origin`."""
    while uid in known:
        uid = int.from_bytes(hashlib.sha256(origin + str(uid).encode()).digest()[:8]) >> 1
    return uid


def renamed_metadata(uid: int, metadata: Mapping[str, Scalar], names: Mapping[int, int]) -> dict[str, Any]:
    """Return the metadata of the episode `uid` whose data's uids are replaced by `names`: old to new."""
    renamed = dict(metadata)
    source = metadata.get("source_episode")
    if isinstance(source, int):
        renamed["source_episode"] = names.get(source, source)
    if names[uid] != uid:
        renamed["merged_uid"] = uid
    return renamed
