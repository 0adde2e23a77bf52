"""The description of a dataset (its provenance), its content hash, and the order of its subsets."""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.core.provenance import origin
from astra_data.dataset.columns import Array
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.integrity import is_sealed
from astra_data.dataset.plain import read_object

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
"""Valid names of datasets; they name folders, with some letters added, and file systems take 255."""
VERSION = re.compile(r"[0-9]{1,9}\.[0-9]{1,9}\.[0-9]{1,9}")
"""Valid versions of datasets."""
_DEFAULTS: dict[str, Any] = {
    "name": None,
    "version": "1.0.0",
    "parents": [],
    "stage": None,
    "config": {},
    "seeds": {},
    "environment": {},
    "simulator": {},
}


def full_name(description: Mapping[str, Any]) -> str:
    """Return "name" and "version" as one, such as "antmaze-long-random-seed0@data-1.0.0"."""
    return f"{description['name']}@data-{description['version']}"


def identity_of(description: Mapping[str, Any]) -> dict[str, str]:
    """Return name, version and hash, as the datasets made from one list it among their parents."""
    return {
        "name": description["name"],
        "version": description["version"],
        "hash": description["content_hash"],
    }


def complete_description(description: Mapping[str, Any]) -> dict[str, Any]:
    """Return the contents of meta/astra/dataset.json, without the content hash.

    Args:
        description: "name" and "stage", and optionally "version" (by default 1.0.0), "parents" (see
            `Dataset.identity`), "config", "seeds", "environment" and "simulator" (ids with parameters).
    """
    full = _DEFAULTS | dict(description)
    faults = [f"unknown key {key!r}, expected {', '.join(_DEFAULTS)}" for key in full.keys() - _DEFAULTS]
    faults += _faults(full)
    try:
        text = json.dumps(full, allow_nan=False, ensure_ascii=False)
        full = json.loads(text.encode())
    except (TypeError, ValueError) as error:
        faults.append(f"expected plain JSON ({error})")
    if faults:
        raise BadInputError(f"Dataset description: {'; '.join(faults)}.")
    return full | origin()


def _faults(description: Mapping[str, Any]) -> list[str]:
    name, version, stage = (description[key] for key in ("name", "version", "stage"))
    faults = []
    if not isinstance(name, str) or not NAME.fullmatch(name):
        faults.append(f"name {name!r:.80}, expected up to 200 letters, digits, '.', '_' and '-'")
    if not isinstance(version, str) or not VERSION.fullmatch(version):
        faults.append(f"version {version!r:.80}, expected three numbers such as 1.0.0")
    if not isinstance(stage, str) or not stage:
        faults.append(f"stage {stage!r:.80}, expected the name of the stage that writes the dataset")
    if not isinstance(parents := description["parents"], Sequence):
        return [*faults, f"parents {parents!r:.80}, expected a list"]
    faults += [
        f"parent {parent!r:.80}, expected name, version and hash"
        for parent in parents
        if not isinstance(parent, Mapping) or sorted(parent) != ["hash", "name", "version"]
    ]
    objects = ("config", "seeds", "environment", "simulator")
    return faults + [
        f"{key} {description[key]!r:.80}, expected an object"
        for key in objects
        if not isinstance(description[key], Mapping)
    ]


class ContentHash:
    """A running sha256 over the values of all columns, independent of their order and the files' encoding."""

    def __init__(self) -> None:
        """Start without columns."""
        self._columns: dict[str, Any] = {}
        self._kinds: dict[str, str] = {}

    def update(self, name: str, values: Array) -> None:
        """Append `values` (n,) or (n, size), contiguous, to column `name`."""
        if name not in self._columns:
            self._columns[name] = hashlib.sha256()
            self._kinds[name] = f"{values.dtype.name}{values.shape[1:]}"
        self._columns[name].update(values.data)

    def hexdigest(self) -> str:
        """Return the hash of all values so far."""
        total = hashlib.sha256()
        for name in sorted(self._columns):
            total.update(f"{name}\0{self._kinds[name]}\0".encode() + self._columns[name].digest())
        return total.hexdigest()


def changed_values(
    before: Mapping[str, Any], after: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """Yield the dotted key and both values (None where absent) wherever two nested descriptions differ."""
    for key in [*before, *(key for key in after if key not in before)]:
        old, new = before.get(key), after.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from changed_values(old, new, f"{prefix}{key}.")
        elif old != new:
            yield f"{prefix}{key}", old, new


def permutation(uids: Iterable[int], seed: int) -> list[int]:
    """Return `uids` in a random order whose prefixes are the nested subsets.

    The sort key of a uid depends on (seed, uid) alone: in all datasets that derive from the same episodes
    they come in the same order, whichever were added or removed.
    """
    return sorted(uids, key=lambda uid: hashlib.sha256(f"{seed} {uid}".encode()).digest())


def read_description(root: Path) -> dict[str, Any]:
    """Return meta/astra/dataset.json: the result of `complete_description`, the content hash, and more."""
    found = read_object(root / DATASET_PATH)
    fault = found if isinstance(found, str) else "" if is_sealed(found) else "was altered"
    if isinstance(found, str) or fault:
        raise CorruptDatasetError(f"{DATASET_PATH} {fault}")
    if faults := _faults({key: found.get(key) for key in _DEFAULTS}):
        raise CorruptDatasetError(f"{DATASET_PATH}: {'; '.join(faults)}")
    return found
