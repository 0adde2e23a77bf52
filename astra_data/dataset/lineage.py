"""The lineage of a dataset: its parents, their parents, and so on."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.errors import CorruptDatasetError
from astra_data.core.naming import RECORD
from astra_data.core.wording import shortened
from astra_data.dataset.description import full_name
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.meta_files import read_description
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import home_of

_Described = tuple[Path, Mapping[str, Any]]
"""Folder and description."""


@dataclass(frozen=True)
class Ancestor:
    """A dataset in the tree.

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

    Raises:
        CorruptDatasetError: a dataset is named among its own ancestors.
    """
    beside = dataset.root.resolve().parent
    return _ancestor(dataset.identity, (dataset.root, dataset.description), beside, ())


def recordings_of(dataset: Dataset) -> NDArray[np.int64]:
    """Return the number of the recording that each episode is, or is a copy of, (E,), from 0 on."""
    sources = dataset.metadata.get("source_episode", [None] * len(dataset))
    numbers: dict[int, int] = {}
    recorded = [uid if source is None else source for uid, source in zip(dataset.uids, sources, strict=True)]
    return np.array([numbers.setdefault(int(uid), len(numbers)) for uid in recorded])


def tree_lines(ancestor: Ancestor) -> Iterator[str]:
    """Yield the tree, one dataset per line, parents indented below their child."""
    yield _line(ancestor)
    for number, parent in enumerate(ancestor.parents, 1):
        is_last = number == len(ancestor.parents)
        first, *rest = tree_lines(parent)
        yield ("└── " if is_last else "├── ") + first
        for line in rest:
            yield ("    " if is_last else "│   ") + line


def _ancestor(
    identity: Mapping[str, str],
    found: _Described | None,
    beside: Path,
    descendants: tuple[Mapping[str, str], ...],
) -> Ancestor:
    reference = full_name(identity)
    if identity in descendants:
        raise CorruptDatasetError(
            f"{reference} is among its own ancestors: a {DATASET_PATH} was altered; restore it from a copy."
        )
    folder, description = found or (None, {})
    parents = description.get("parents", [])
    below = (*descendants, identity)
    return Ancestor(
        reference=reference,
        content_hash=identity["hash"],
        stage=description.get("stage", ""),
        config=description.get("config", {}),
        parents=tuple(_ancestor(parent, _found(parent, beside), beside, below) for parent in parents),
        folder=folder,
    )


def _found(identity: Mapping[str, str], beside: Path) -> _Described | None:
    places = [beside.glob(f"*/{DATASET_PATH}")]
    for folder in beside.parents[:2]:
        if (folder / RECORD).exists():
            places += [folder.glob(f"{depth}/{DATASET_PATH}") for depth in ("*/*", "*/*/*")]
    neighbors = [path.parents[2] for place in places for path in sorted(place)]
    for folder in (home_of(identity), *neighbors):
        try:
            found = read_description(folder)
        except CorruptDatasetError:
            continue
        # A dataset may hold the same values under another name or version.
        if identity == {"name": found["name"], "version": found["version"], "hash": found["content_hash"]}:
            return folder, found
    return None


def _line(ancestor: Ancestor) -> str:
    if ancestor.folder is None:
        return f"{ancestor.reference}  {ancestor.content_hash[:8]}  (not found here)"
    settings = ", ".join(
        f"{key} {shortened(str(value), 40)}" for key, value in ancestor.config.items() if value is not None
    )
    return f"{ancestor.reference}  {ancestor.content_hash[:8]}  {ancestor.stage}" + (
        f": {settings}" if settings else ""
    )
