"""The lineage of a dataset: its parents, their parents, and so on."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.errors import CorruptDatasetError
from astra_data.core.naming import RECORD
from astra_data.core.wording import printable, shortened
from astra_data.dataset.description import full_name, identity_of
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.meta_files import read_description
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import home_of

_Described = tuple[Path, Mapping[str, Any]]
"""Folder and description."""
_Key = tuple[str, str, str]
"""Name, version and content hash."""


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

    Raises:
        CorruptDatasetError: a dataset is named among its own ancestors.
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
