"""Interface of the places where datasets are shared."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from astra_data.core.durable import file_digest
from astra_data.core.errors import SharingError
from astra_data.core.progress import Progress
from astra_data.dataset import format as layout
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version
from astra_data.io.hub.sums import Listed

TEXT_BYTES = 2**26
"""Most bytes of a description or of SHA256SUMS; some hundred thousand recordings or files fit into it."""
DEPTH = 4
"""Folders inside each other, at most: data/chunk-000/file-000.parquet needs three."""
MOST_FOLDERS = 2000
"""Folders of a dataset on HTTP, each a request."""
MOST_FILES = 10**6
BLOCK_BYTES = 2**24
"""Bytes per request."""


@dataclass(frozen=True)
class RemoteFolder:
    """The files of one version, wherever they are; of what a stranger put there, only plain files are read.

    Attributes:
        filesystem: an fsspec file system.
        path: of the folder in it.
        name: of the version, for messages.
    """

    filesystem: Any
    path: str
    name: str

    def files(self) -> dict[str, dict[str, Any]]:
        """Return what the file system tells of each file, such as its "size", by the path in the folder.

        Raises:
            SharingError: the folder cannot be listed, or something in it is a link, a device or a pipe.
        """
        try:
            self.filesystem.invalidate_cache()
            is_link = self.filesystem.info(self.path).get("islink", False)
            found = self._listed()
        except SharingError:
            raise
        except Exception as error:
            cause = f"{type(error).__name__}: {error}"
            raise SharingError(f"{self.name} cannot be listed ({cause}).") from error
        files = {str(path).removeprefix(self.path).lstrip("/"): facts for path, facts in found.items()}
        strange = [path for path, facts in files.items() if not _is_plain(facts)]
        if strange or is_link:
            raise SharingError(
                f"{self.name}: {', '.join(strange) or 'its folder'} is a link, a device or a pipe, expected "
                "files; nothing was downloaded."
            )
        return files

    def _listed(self) -> dict[str, dict[str, Any]]:
        """Return what the file system tells of each file by its path, as deep as datasets are.

        Over HTTP every folder is a request, and what a stranger's server lists has no end of its own.
        """
        if not {"http", "https"} & {*self._protocols()}:
            return dict(self.filesystem.find(self.path, maxdepth=DEPTH, detail=True))
        files: dict[str, dict[str, Any]] = {}
        for number, (_, folders, found) in enumerate(
            self.filesystem.walk(self.path, maxdepth=DEPTH, detail=True), 1
        ):
            files |= {str(facts["name"]): facts for facts in found.values()}
            if max(number, len(folders)) > MOST_FOLDERS or len(files) > MOST_FILES:
                raise SharingError(
                    f"{self.name} lists more than {MOST_FOLDERS:,} folders or {MOST_FILES:,} files, which no "
                    "dataset has; nothing was downloaded."
                )
        return files

    def _protocols(self) -> tuple[str, ...]:
        found = self.filesystem.protocol
        return (found,) if isinstance(found, str) else tuple(found)

    def read_text(self, path: str) -> str:
        """Return the text of the small file `path`.

        Raises:
            SharingError: it cannot be read, is not there, or is larger than `TEXT_BYTES`.
        """
        try:
            if not _is_plain(self.filesystem.info(f"{self.path}/{path}")):
                raise SharingError(f"{self.name}: {path} is a link, a device or a pipe, expected a file.")
            content = b"".join(self.blocks(path, most=TEXT_BYTES + 1))
            if len(content) <= TEXT_BYTES:
                return content.decode()
        except SharingError:
            raise
        except FileNotFoundError as error:
            raise SharingError(f"{self.name} has no {path}: it was not pushed by astra-data.") from error
        except Exception as error:
            cause = f"{type(error).__name__}: {error}"
            raise SharingError(f"{self.name}: {path} cannot be read ({cause}).") from error
        raise SharingError(f"{self.name}: {path} is larger than {TEXT_BYTES // 2**20} MB.")

    def blocks(self, path: str, *, first: int = 0, most: int) -> Iterator[bytes]:
        """Yield the bytes of the file `path` from `first` on, at most `most` in all, in blocks."""
        options = {"block_size": BLOCK_BYTES, "cache_type": "none"}
        with self.filesystem.open(f"{self.path}/{path}", "rb", **options) as source:
            if first:
                source.seek(min(first, source.size))
            while most > 0 and (block := source.read(min(BLOCK_BYTES, most))):
                most -= len(block)
                yield block

    def altered(self, sums: Mapping[str, Listed]) -> list[str]:
        """Return which files of `sums` are missing here or differ, as far as is known without a download.

        Sizes are compared everywhere, the sha256 on the Hugging Face Hub and in folders of this machine.

        Raises:
            SharingError: the folder cannot be listed or read, or something in it is no plain file.
        """
        files = self.files()
        return [
            path
            for path, listed in sums.items()
            if path not in files
            or files[path].get("size") not in (None, listed.size)
            or self._digest(path, files[path]) not in (None, listed.digest)
        ]

    def _digest(self, path: str, facts: Mapping[str, Any]) -> str | None:
        """Return the sha256 of a file, None where it would have to be downloaded for that."""
        if "file" in self._protocols():
            return file_digest(Path(self.path, path))
        large = facts.get("lfs")
        return large["sha256"] if large else None

    def description(self) -> dict[str, Any]:
        """Return meta/astra/dataset.json.

        Raises:
            SharingError: it cannot be read.
        """
        text = self.read_text(layout.DATASET_PATH)
        try:
            return dict(json.loads(text))
        except (RecursionError, TypeError, ValueError) as error:
            raise SharingError(
                f"{self.name}: {layout.DATASET_PATH} is not a JSON object ({error})."
            ) from error


def _is_plain(facts: Mapping[str, Any]) -> bool:
    return facts.get("type") == "file" and not facts.get("islink", False)


class Store(Protocol):
    """A place that holds the versions of one dataset."""

    def versions(self) -> list[Version]:
        """Return the complete versions, the oldest first."""

    def folder(self, version: Version) -> RemoteFolder:
        """Return the folder with the files of `version`."""

    def upload(self, dataset: Dataset, card: Path, progress: Progress) -> None:
        """Upload `dataset` as a new version, which is listed once it is complete.

        Args:
            dataset: complete and verified.
            card: a folder with SHA256SUMS, README.md and perhaps its figure.
            progress: called with the fraction done.
        """
