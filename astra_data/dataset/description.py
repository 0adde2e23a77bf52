"""The description of a dataset (its provenance), its content hash, and the order of its subsets."""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from astra_data.core.config import Config, Count, validated
from astra_data.core.errors import BadInputError, CorruptDatasetError, RecipeError
from astra_data.core.provenance import origin
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.format import DATASET_PATH, INFO_PATH, SUBSETS_PATH
from astra_data.dataset.integrity import is_description_sealed
from astra_data.dataset.plain import MOST_FPS, is_data_path, read_object

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
NameText = Annotated[str, Field(pattern=f"^{NAME.pattern}$")]
VersionText = Annotated[str, Field(pattern=f"^{VERSION.pattern}$")]
"""Names and versions of datasets in files."""


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
    if not isinstance(full["name"], str) or not NAME.fullmatch(full["name"]):
        faults.append(f"name {full['name']!r}, expected up to 200 letters, digits, '.', '_' and '-'")
    if not isinstance(full["version"], str) or not VERSION.fullmatch(full["version"]):
        faults.append(f"version {full['version']!r:.80}, expected three numbers such as 1.0.0")
    if not isinstance(full["stage"], str) or not full["stage"]:
        faults.append(f"stage {full['stage']!r}, expected the name of the stage that writes the dataset")
    for parent in full["parents"]:
        if sorted(parent) != ["hash", "name", "version"]:
            faults.append(f"parent {dict(parent)}, expected name, version and hash")
    try:
        text = json.dumps(full, allow_nan=False, ensure_ascii=False)
        full = json.loads(text.encode())
    except (TypeError, ValueError) as error:
        faults.append(f"expected plain JSON ({error})")
    if faults:
        raise BadInputError(f"Dataset description: {'; '.join(faults)}.")
    return full | origin()


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


def _data_path(pattern: str) -> str:
    if not is_data_path(pattern):
        raise ValueError(f"expected a path inside the dataset's folder, got {pattern!r}")
    return pattern


class _Open(Config):
    """Like `Config`, but accepts further keys, which other tools may add."""

    model_config = ConfigDict(extra="allow")


class _Meaning(Config):
    meaning: str = ""
    unit: tuple[str, ...] = ()
    frame: tuple[str, ...] = ()
    role: tuple[str, ...] = ()


class _Feature(_Open):
    dtype: Literal["float32", "int64", "bool"]
    shape: tuple[Count]
    names: tuple[str, ...] | None = None
    astra: _Meaning | None = None


class _Info(_Open):
    fps: int = Field(ge=1, lt=MOST_FPS)
    features: dict[str, _Feature]
    total_episodes: Count
    total_frames: Count
    data_path: Annotated[str, AfterValidator(_data_path)]


class _Identity(Config):
    name: NameText
    version: VersionText
    hash: str


class _Description(_Open):
    name: NameText
    version: VersionText
    parents: tuple[_Identity, ...]
    stage: str = Field(min_length=1)
    config: dict[str, Any]
    seeds: dict[str, Any]
    environment: dict[str, Any]
    simulator: dict[str, Any]
    packages: dict[str, str]
    git_commit: str | None
    content_hash: str
    sums: dict[str, str]


class _Subsets(_Open):
    seed: int
    uids: tuple[int, ...]


def read_info(root: Path) -> dict[str, Any]:
    """Return meta/info.json of the dataset in folder `root`; its features are valid columns."""
    info = _read(root / INFO_PATH, INFO_PATH, _Info)
    faults = []
    for name, feature in info["features"].items():
        try:
            Column.from_feature(name, feature)
        except BadInputError as error:
            faults.append(str(error))
    if faults:
        raise CorruptDatasetError(f"{INFO_PATH}: {' '.join(faults)}")
    return info


def read_description(root: Path) -> dict[str, Any]:
    """Return meta/astra/dataset.json: the result of `complete_description`, the content hash, and more."""
    description = _read(root / DATASET_PATH, DATASET_PATH, _Description)
    if not is_description_sealed(description):
        raise CorruptDatasetError(f"{DATASET_PATH} was altered")
    return description


def read_subsets(root: Path) -> dict[str, Any]:
    """Return meta/astra/subsets.json: "seed" and "uids"."""
    return _read(root / SUBSETS_PATH, SUBSETS_PATH, _Subsets)


def _read(path: Path, name: str, model: type[BaseModel]) -> dict[str, Any]:
    found = read_object(path)
    if isinstance(found, str):
        raise CorruptDatasetError(f"{name} {found}")
    try:
        validated(found, model, name)
    except RecipeError as error:
        raise CorruptDatasetError(str(error).replace(":\n  ", ": ").replace("\n  ", "; ")) from error
    return found
