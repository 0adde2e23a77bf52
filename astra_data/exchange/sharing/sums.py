"""SHA256SUMS: the files of a shared dataset and their checksums, in the format of `sha256sum`."""

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from astra_data.core.digest import file_digest
from astra_data.core.errors import SharingError

SUMS_PATH = "SHA256SUMS"

_PATH = re.compile(r"(data|meta)(/[A-Za-z0-9_][A-Za-z0-9._=-]*)+")
"""Paths of the files of a dataset; none of them leads out of its folder."""

_LINE = re.compile(r"(?P<digest>[0-9a-f]{64}) [ *](?P<path>.+)")


def dataset_files(root: Path) -> list[str]:
    """List the files that belong to the dataset in folder `root`, relative to it, and no others."""
    paths = (path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
    return sorted(path for path in paths if _PATH.fullmatch(path))


def make_sums(root: Path) -> str:
    """Return SHA256SUMS of the dataset in folder `root`."""
    return "".join(f"{file_digest(root / path)}  {path}\n" for path in dataset_files(root))


def parse_sums(text: str, source: str) -> Mapping[str, str]:
    """Read SHA256SUMS: file path to sha256.

    Raises:
        SharingError: a line is malformed, or a path is not one of a dataset, such as one that leads out of
            the folder; lists every fault.
    """
    sums: dict[str, str] = {}
    faults = []
    for number, line in enumerate(text.splitlines(), start=1):
        found = _LINE.fullmatch(line)
        if not found:
            faults.append(f"line {number} is not a sha256 with a path")
        elif not _PATH.fullmatch(found["path"]):
            faults.append(f"line {number} has the path {found['path']!r}, expected one within data/ or meta/")
        elif found["path"] in sums:
            faults.append(f"line {number} lists {found['path']} again")
        else:
            sums[found["path"]] = found["digest"]
    folders = {parent.as_posix() for path in sums for parent in PurePosixPath(path).parents}
    faults += [f"{path} is listed as a file and as a folder" for path in sums if path in folders]
    if faults:
        raise SharingError(
            f"{source}: {SUMS_PATH} cannot be trusted: {'; '.join(faults)}. Nothing was downloaded."
        )
    return sums
