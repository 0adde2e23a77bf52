"""The manifest of an artifact: its files with their sizes and sha256, and what it was made from.

    {"files": {"policy.safetensors": {"bytes": 13948, "sha256": "…"}, …},
     "made_from": {"dataset": "<content hash>", "grounding": "<sha256 of grounding.safetensors>"}}

It is written into the working folder of an artifact, so that both appear at once. The settings are in one of
the files. Datasets have none: their description says the same.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from astra_data.core.digest import file_digest
from astra_data.core.errors import BadInputError

MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Manifest:
    """What a finished artifact consists of.

    Attributes:
        files: path inside the folder → its size in bytes and its sha256.
        made_from: what the artifact was made from → the digest of that.
    """

    files: Mapping[str, tuple[int, str]]
    made_from: Mapping[str, str]

    def faults(self, folder: Path, *, verify: bool) -> list[str]:
        """Return what `folder` lost: by the sizes of its files, with `verify` by their sha256 too."""
        found, faults = _files(folder), []
        for name, (size, digest) in self.files.items():
            if name not in found:
                faults.append(f"{name} is missing")
            elif (now := found[name].stat().st_size) != size:
                faults.append(f"{name} has {now:,} bytes, expected {size:,}")
            elif verify and file_digest(found[name]) != digest:
                faults.append(f"{name} was altered")
        return faults

    def foreign(self, folder: Path) -> list[str]:
        """Return the files in `folder` that are not of the artifact."""
        return [name for name in _files(folder) if name not in self.files]


def check_intact(path: Path) -> None:
    """Refuse a file whose bytes are not those in the manifest beside it, if there is one.

    Raises:
        BadInputError: it was altered, or the manifest cannot be read.
    """
    manifest = _manifest_beside(path)
    if manifest and path.name in manifest.files and manifest.files[path.name][1] != file_digest(path):
        raise BadInputError(
            f"{path} was altered since it was made: restore it from a copy, or remove {path.parent} and run "
            "the recipe again"
        )


def check_made_from(made: Path, read: Mapping[str, str | None]) -> None:
    """Refuse the artifact of a file `made` that was made from others than those that are `read` with it.

    Args:
        made: a file of the artifact.
        read: name as in `made_from` → digest now; None where there is none.

    Raises:
        BadInputError: its manifest has another digest under one of these names.
    """
    manifest = _manifest_beside(made)
    made_from = manifest.made_from if manifest else {}
    if others := [name for name, digest in read.items() if digest and made_from.get(name, digest) != digest]:
        raise BadInputError(
            f"{made.parent} was made from another {' and another '.join(others)} than the one used with it: "
            "restore the folders that belong together from a copy, or run the recipe again"
        )


def write_manifest(folder: Path, made_from: Mapping[str, str | None]) -> None:
    """Write the manifest of all that is in `folder` now, leaving out of `made_from` what is None."""
    files = {
        name: {"bytes": path.stat().st_size, "sha256": file_digest(path)}
        for name, path in _files(folder).items()
    }
    digests = {name: digest for name, digest in made_from.items() if digest}
    (folder / MANIFEST).write_text(json.dumps({"files": files, "made_from": digests}, indent=1))


def read_manifest(folder: Path) -> Manifest | None:
    """Return the manifest of the artifact in `folder`; None if it has none.

    Raises:
        BadInputError: it cannot be read.
    """
    path = folder / MANIFEST
    if not path.exists():
        return None
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        files = {name: (int(file["bytes"]), str(file["sha256"])) for name, file in content["files"].items()}
        return Manifest(files, dict(content["made_from"]))
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise BadInputError(f"{MANIFEST} cannot be read ({error})") from None


def _manifest_beside(file: Path) -> Manifest | None:
    try:
        return read_manifest(file.parent)
    except BadInputError as error:
        raise BadInputError(f"{file.parent}: {error}") from None


def _files(folder: Path) -> dict[str, Path]:
    """Return the files in `folder`, by their paths inside it, without its manifest."""
    files = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*"))}
    return {name: path for name, path in files.items() if path.is_file() and name != MANIFEST}
