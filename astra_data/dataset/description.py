"""The description of a dataset (its provenance), its content hash, and the order of its subsets."""

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike, NDArray
from xxhash import xxh3_64_intdigest

from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError, CorruptDatasetError, unmet
from astra_data.core.provenance import origin
from astra_data.dataset import format as layout
from astra_data.dataset.columns import Array
from astra_data.dataset.format import to_arrow, to_numpy
from astra_data.dataset.plain import episodes_files, read_object, read_small_table

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
"""Valid names of datasets; they name folders, with some letters added, and file systems take 255."""
VERSION = re.compile(r"[0-9]{1,9}\.[0-9]{1,9}\.[0-9]{1,9}")  # valid versions of datasets
_DEFAULTS: dict[str, Any] = {"name": None, "version": "1.0.0", "parents": [], "stage": None}
_DEFAULTS |= {"config": {}, "seeds": {}, "environment": {}, "simulator": {}}
digest_of = xxh3_64_intdigest  # of contiguous values (T,) or (T, size) of one episode
Digests = Mapping[str, NDArray[np.uint64]]  # column to the digest of each episode, (E,)
SEALED = (
    layout.INFO_PATH,
    layout.STATS_PATH,
    layout.TASKS_PATH,
    layout.METADATA_PATH,
    layout.SUBSETS_PATH,
    layout.DIGESTS_PATH,
)  # the files with a sum, beside the description and those of meta/episodes


def full_name(description: Mapping[str, Any]) -> str:
    """Return "name" and "version" as one, such as "antmaze-long-random-seed0@data-1.0.0"."""
    return f"{description['name']}@data-{description['version']}"


def identity_of(description: Mapping[str, Any]) -> dict[str, str]:
    """Return name, version and hash, as the datasets made from one list it among their parents."""
    return {"name": description["name"], "version": description["version"], "hash": description["content_hash"]}


def complete_description(description: Mapping[str, Any]) -> dict[str, Any]:
    """Return the contents of meta/astra/dataset.json, without the content hash; a `description` has name and stage."""
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
    name, version, stage, parents = (description[key] for key in ("name", "version", "stage", "parents"))
    checks = {
        f"name {name!r:.80}, expected up to 200 of A-Z, a-z, 0-9, '.', '_' and '-', a letter or digit first": (
            isinstance(name, str) and NAME.fullmatch(name)
        ),
        f"version {version!r:.80}, expected three numbers such as 1.0.0": (
            isinstance(version, str) and VERSION.fullmatch(version)
        ),
        f"stage {stage!r:.80}, expected the name of the stage that writes it": isinstance(stage, str) and stage,
        f"parents {parents!r:.80}, expected a list": isinstance(parents, Sequence),
    }
    for parent in parents if isinstance(parents, Sequence) else ():
        is_one = isinstance(parent, Mapping) and sorted(parent) == ["hash", "name", "version"]
        checks[f"parent {parent!r:.80}, expected name, version and hash"] = is_one
    for key in ("config", "seeds", "environment", "simulator"):
        checks[f"{key} {description[key]!r:.80}, expected an object"] = isinstance(description[key], Mapping)
    return unmet(checks)


class ContentHash:
    """A running sha256 over the values of all columns, independent of their order and the files' encoding."""

    def __init__(self) -> None:
        self._columns: dict[str, tuple[str, Any]] = {}

    def update(self, name: str, values: Array) -> None:
        """Append `values` (n,) or (n, size), contiguous, to column `name`."""
        _, running = self._columns.setdefault(name, (f"{values.dtype.name}{values.shape[1:]}", hashlib.sha256()))
        running.update(values.data)

    def hexdigest(self) -> str:
        """Return the hash of all values so far."""
        total = hashlib.sha256()
        for name, (kind, running) in sorted(self._columns.items()):
            total.update(f"{name}\0{kind}\0".encode() + running.digest())
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
    """Return `uids` in a random order, by seed and uid alone, whose prefixes are the nested subsets."""
    return sorted(uids, key=lambda uid: hashlib.sha256(f"{seed} {uid}".encode()).digest())


def read_description(root: Path) -> dict[str, Any]:
    """Return meta/astra/dataset.json: the result of `complete_description`, the content hash, and more."""
    found = read_object(root / layout.DATASET_PATH)
    if isinstance(found, str):
        raise CorruptDatasetError(f"{layout.DATASET_PATH} {found}")
    if not isinstance(sums := found.get("sums"), dict) or sums.get(layout.DATASET_PATH) != _sum_of(found):
        raise CorruptDatasetError(f"{layout.DATASET_PATH} was altered")
    if faults := _faults({key: found.get(key) for key in _DEFAULTS}):
        raise CorruptDatasetError(f"{layout.DATASET_PATH}: {'; '.join(faults)}")
    return found


def alteration(columns: Mapping[str, Array], episode: int, digests: Digests, path: Path, row: int) -> str | None:
    """Say which `columns` of an episode, from `row` of the file at `path` on, differ from their digests, if any do."""
    written = {name: each[episode] for name, each in digests.items() if episode < len(each)}
    altered = [name for name, values in columns.items() if name in written and digest_of(values) != written[name]]
    if not altered:
        return None
    where = f"{'/'.join(path.parts[-3:])} rows {row} to {row + len(columns[altered[0]]) - 1}"
    return f"{', '.join(altered)}: other values than were written in {where} (episode {episode})"


def write_digests(root: Path, digests: Mapping[str, ArrayLike]) -> None:
    """Write meta/astra/digests.parquet, plain: random bits neither compress nor repeat."""
    table = pa.table({name: to_arrow(np.asarray(values, np.uint64)) for name, values in digests.items()})
    pq.write_table(table, root / layout.DIGESTS_PATH, compression="none", use_dictionary=False, write_statistics=False)


def read_digests(root: Path, columns: Collection[str], altered: Collection[str] = ()) -> Digests:
    """Return the digests of `columns`, unless their file is among those `altered`."""
    table = "was altered" if layout.DIGESTS_PATH in altered else read_small_table(root / layout.DIGESTS_PATH)
    if isinstance(table, str):
        raise CorruptDatasetError(f"{layout.DIGESTS_PATH} {table}")
    whole = [field.name for field in table.schema if field.type == pa.uint64()]
    if sorted(whole) != sorted(columns) or any(column.null_count for column in table.columns):
        raise CorruptDatasetError(f"{layout.DIGESTS_PATH} has other columns than the data")
    return {name: to_numpy(table.column(name), 1, "uint64") for name in columns}


def sealed(root: Path, description: Mapping[str, Any]) -> dict[str, Any]:
    """Return `description`, as JSON gives it back, with the sums of the files in folder `root`."""
    sums = {path: file_digest(root / path) for path in (*SEALED, *_episodes(root))}
    full: dict[str, Any] = json.loads(json.dumps({**description, "sums": sums}))
    full["sums"][layout.DATASET_PATH] = _sum_of(full)
    return full


def altered_files(root: Path, description: Mapping[str, Any]) -> list[str]:
    """Return the sealed files in folder `root` that were altered or are missing, and those added to them."""
    sums = {path: value for path, value in description.get("sums", {}).items() if path != layout.DATASET_PATH}
    paths = (*SEALED, *sorted({*sums, *_episodes(root)} - {*SEALED})) if sums else ()
    return [path for path in paths if not (root / path).is_file() or file_digest(root / path) != sums.get(path)]


def _episodes(root: Path) -> list[str]:
    return [path.relative_to(root).as_posix() for path in episodes_files(root)]


def _sum_of(description: Mapping[str, Any]) -> str:
    sums = {path: value for path, value in description["sums"].items() if path != layout.DATASET_PATH}
    return hashlib.sha256(json.dumps({**description, "sums": sums}, sort_keys=True).encode()).hexdigest()
