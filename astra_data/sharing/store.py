"""What every place offers where datasets are shared."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from astra_data.dataset import Dataset
from astra_data.dataset.versions import Version
from astra_data.progress import Progress


@dataclass(frozen=True)
class RemoteFolder:
    """The files of one version, wherever they are.

    Attributes:
        filesystem: an fsspec file system.
        path: of the folder in it.
    """

    filesystem: Any
    path: str


class Store(Protocol):
    """A place that holds the versions of one dataset."""

    def versions(self) -> list[Version]:
        """Return the versions that are there whole, the oldest first."""

    def folder(self, version: Version) -> RemoteFolder:
        """Return where the files of `version` are read."""

    def upload(self, dataset: Dataset, card: Path, progress: Progress) -> None:
        """Add `dataset` as a new version; it counts as there once everything is.

        Args:
            dataset: whole and verified.
            card: a folder with SHA256SUMS, README.md and perhaps its figure.
            progress: is told how far it is.
        """
