"""Interface of the places where datasets are shared."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from astra_data.core.errors import SharingError
from astra_data.core.progress import Progress
from astra_data.dataset import Dataset
from astra_data.dataset import format as layout
from astra_data.dataset.versions import Version


@dataclass(frozen=True)
class RemoteFolder:
    """The files of one version, wherever they are.

    Attributes:
        filesystem: an fsspec file system.
        path: of the folder in it.
        name: of the version, for messages.
    """

    filesystem: Any
    path: str
    name: str

    def read_text(self, path: str) -> str:
        """Return the text of the small file `path`.

        Raises:
            SharingError: it cannot be read, or is not there.
        """
        try:
            return str(self.filesystem.cat_file(f"{self.path}/{path}").decode())
        except FileNotFoundError as error:
            raise SharingError(f"{self.name} has no {path}: it was not pushed by astra-data.") from error
        except Exception as error:
            cause = f"{type(error).__name__}: {error}"
            raise SharingError(f"{self.name}: {path} cannot be read ({cause}).") from error

    def description(self) -> dict[str, Any]:
        """Return meta/astra/dataset.json.

        Raises:
            SharingError: it cannot be read.
        """
        text = self.read_text(layout.DATASET_PATH)
        try:
            return dict(json.loads(text))
        except (TypeError, ValueError) as error:
            raise SharingError(
                f"{self.name}: {layout.DATASET_PATH} is not a JSON object ({error})."
            ) from error


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
