"""What a command made, as one text: equal texts, equal values. Times and places are left out."""

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from astra_data.core.errors import AstraDataError
from astra_data.dataset.doctor.check import check
from astra_data.dataset.reader import Dataset
from astra_data.io.hub.stores import UrlStore

Look = Callable[[Path], str | None]
"""Describes what is at a path: None if there is nothing, and "damaged: ..." if it is not whole."""

_OF_THE_MOMENT = re.compile(
    r"\w*(seconds|per_second|cost)|finished_at|created|git_commit|packages|machine|meta/astra/dataset.json|\w+\.json"
)
"""Keys of JSON files whose values differ from run to run; the last two have the sums of such files."""


def dataset(root: Path) -> str | None:
    """Describe a dataset by its verified content hash, its description and its episodes' metadata."""
    if not root.exists():
        return None
    try:
        opened = Dataset.open(root)
        faults = check(root).faults
    except AstraDataError as error:
        return f"damaged: {error}"
    if faults:
        return f"damaged: {faults}"
    extra = _digest((path, _content(path)) for path in _files(root / "meta/astra"))
    return f"{opened.content_hash} {extra}"


def hdf5(path: Path) -> str | None:
    """Describe an HDF5 file by all its values and attributes."""
    if not path.exists():
        return None
    parts: list[tuple[Path, bytes]] = []

    def visit(name: str, item: Any) -> None:  # noqa: ANN401 - h5py has no types
        told = sorted((key, repr(value)) for key, value in item.attrs.items())
        values = repr(np.asarray(item[()]).tolist()) if isinstance(item, h5py.Dataset) else ""
        parts.append((Path(name), f"{told}{values}".encode()))

    try:
        with h5py.File(path) as file:
            file.visititems(visit)
    except (OSError, RuntimeError) as error:
        return f"damaged: {error}"
    return _digest(parts)


def files(path: Path) -> str | None:
    """Describe a file, or a folder by all its files, also HDF5 ones."""
    if not path.exists():
        return None
    if path.is_file():
        return _digest([(path, _content(path))])
    found = _files(path)
    return _digest((file.relative_to(path), _content(file)) for file in found) if found else None


def card(path: Path) -> str | None:
    """Describe a card and its figure, which are two files."""
    return files(path) and _digest((Path(file.name), _content(file)) for file in sorted(path.parent.glob("out*")))


def remote(path: Path) -> str | None:
    """Describe the versions that a shared dataset offers."""
    if not path.exists():
        return None
    versions = UrlStore(path.as_uri()).versions()
    return ", ".join(f"{one.tag} {files(path / one.tag)}" for one in versions) or None


def _files(folder: Path) -> list[Path]:
    """Return the visible files below `folder`."""
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    return [path for path in found if not any(part.startswith(".") for part in path.relative_to(folder).parts)]


def _content(path: Path) -> bytes:
    if path.suffix in (".h5", ".hdf5"):
        return (hdf5(path) or "").encode()
    data = path.read_bytes()
    if path.suffix != ".json":
        return data
    try:
        return json.dumps(_lasting(json.loads(data)), sort_keys=True).encode()
    except ValueError:
        return data


def _lasting(value: Any) -> Any:  # noqa: ANN401 - JSON
    if isinstance(value, dict):
        return {key: _lasting(item) for key, item in value.items() if not _OF_THE_MOMENT.fullmatch(key)}
    return [_lasting(item) for item in value] if isinstance(value, list) else value


def _digest(parts: "list[tuple[Path, bytes]] | Iterator[tuple[Path, bytes]]") -> str:
    digest = hashlib.sha256()
    for path, data in parts:
        digest.update(f"{path.name} {len(data)} ".encode() + data)
    return digest.hexdigest()[:16]
