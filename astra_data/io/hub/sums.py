"""SHA256SUMS: the files of a shared dataset, their checksums and sizes, in the format of `sha256sum`.

Sizes are in comments, which `sha256sum` skips: "# 1234 bytes  meta/info.json".
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from astra_data.core.durable import file_digest
from astra_data.core.errors import SharingError

SUMS_PATH = "SHA256SUMS"

_NUMBERED = r"chunk-[0-9]{3,}/file-[0-9]{3,}\.parquet"
_PATH = re.compile(
    rf"(data|meta/episodes)/{_NUMBERED}"
    r"|meta/(info\.json|stats\.json|tasks\.parquet)"
    r"|meta/astra/[a-z_]+\.(json|parquet|safetensors)"
)
"""Paths of the files of a dataset, by the names of the format; none of them leads out of its folder."""
_PLACES = ("data/*/*", "meta/*", "meta/astra/*", "meta/episodes/*/*")
"""Where they are looked for, also where a folder is a link."""

_LINE = re.compile(r"(?P<digest>[0-9a-f]{64}) [ *](?P<path>.+)")
_SIZE = re.compile(r"# (?P<size>[0-9]{1,18}) bytes  (?P<path>.+)")


@dataclass(frozen=True)
class Listed:
    """A file as it should be: its sha256, and its size in bytes."""

    digest: str
    size: int


def dataset_files(root: Path) -> list[str]:
    """List the files that belong to the dataset in folder `root`, relative to it, and no others."""
    found = (path for places in _PLACES for path in root.glob(places) if path.is_file())
    paths = (path.relative_to(root).as_posix() for path in found)
    return sorted(path for path in paths if _PATH.fullmatch(path))


def make_sums(root: Path) -> str:
    """Return SHA256SUMS of the dataset in folder `root`."""
    files = {path: root / path for path in dataset_files(root)}
    sums = [f"{file_digest(file)}  {path}\n" for path, file in files.items()]
    return "".join(sums + [f"# {file.stat().st_size} bytes  {path}\n" for path, file in files.items()])


def parse_sums(text: str, source: str) -> dict[str, Listed]:
    """Read SHA256SUMS: file path to what is listed of it.

    Raises:
        SharingError: a line is malformed, or a path is not one of a dataset, such as a script or one that
            leads out of the folder; lists every fault.
    """
    sums: dict[str, str] = {}
    sizes: dict[str, int] = {}
    faults = []
    for number, line in enumerate(text.splitlines(), start=1):
        if found := _SIZE.fullmatch(line):
            sizes[found["path"]] = int(found["size"])
        elif not (found := _LINE.fullmatch(line)):
            faults.append(f"line {number} is not a sha256 with a path")
        elif not _PATH.fullmatch(found["path"]):
            faults.append(
                f"line {number} has the path {found['path']!r}, expected one of a dataset's files, "
                "within data/ or meta/"
            )
        elif found["path"] in sums:
            faults.append(f"line {number} lists {found['path']} again")
        else:
            sums[found["path"]] = found["digest"]
    halves = sorted(sizes.keys() ^ sums.keys())
    faults += [f"{path} is listed without {'sha256' if path in sizes else 'size'}" for path in halves]
    if faults:
        raise SharingError(f"{source}: {SUMS_PATH} cannot be trusted: {'; '.join(faults)}. Nothing was downloaded.")
    return {path: Listed(digest, sizes[path]) for path, digest in sums.items()}


def altered(root: Path, sums: Mapping[str, Listed]) -> list[str]:
    """Return which files of `sums` are missing from folder `root` or differ, by size or else by sha256."""
    return [path for path, listed in sums.items() if not _is_whole(root / path, listed)]


def _is_whole(file: Path, listed: Listed) -> bool:
    if not file.is_file() or listed.size != file.stat().st_size:
        return False
    return file_digest(file) == listed.digest
