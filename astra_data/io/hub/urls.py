"""Datasets at any URL that fsspec knows: <url>/<name>/data-<version>/."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from astra_data.core.durable import hidden_folder, move, sync, writing
from astra_data.core.errors import AstraDataError, BadInputError, SharingError
from astra_data.core.optional import how_to_install
from astra_data.core.progress import Progress
from astra_data.dataset import format as layout
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version
from astra_data.io.hub.store import RemoteFolder
from astra_data.io.hub.sums import SUMS_PATH, dataset_files

MOST_FOLDERS = 20
"""Folders in which datasets are looked for, each with a request of its own."""
MOST_VERSIONS = 1000
EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs"}
"""Protocol → the extra of this package that is needed for it."""


class UrlStore:
    """The versions of one dataset below a URL; a version counts once its `layout.DATASET_PATH` exists."""

    def __init__(self, url: str) -> None:
        """Take the folder `url`, whose last part is the dataset's name.

        Raises:
            BadInputError: no installed package handles such a URL.
        """
        import fsspec  # noqa: PLC0415 - slow to import

        self._url = url
        protocol = url.partition("://")[0].lower()
        self._is_local = protocol in ("file", "local")
        with _explained(url):
            try:
                self._filesystem, self._path = fsspec.core.url_to_fs(url)
            except ImportError as error:
                extra = EXTRAS.get(protocol)
                how = how_to_install(extra) if extra else error
                raise BadInputError(
                    f"{url}: the package for {protocol}:// is not installed: {how}"
                ) from error
            except ValueError as error:
                raise BadInputError(f"{url}: {error}; expected a URL such as s3://bucket/folder") from error

    def versions(self) -> list[Version]:
        """Return the complete versions, the oldest first."""
        with _explained(self._url):
            self._filesystem.invalidate_cache()
            try:
                found = self._filesystem.ls(self._path, detail=False)
            except FileNotFoundError:
                return []
            tags = (str(path).rstrip("/").rpartition("/")[2] for path in found)
            versions = {version for tag in tags if (version := Version.from_tag(tag))}
            if len(versions) > MOST_VERSIONS:  # each is a request
                raise SharingError(f"{self._url} lists more than {MOST_VERSIONS} versions")
            return sorted(version for version in versions if self._filesystem.exists(self._mark(version)))

    def datasets(self) -> list[str]:
        """Return the URLs of the datasets that the first of its folders are, where it holds several."""
        with _explained(self._url):
            try:
                found = self._filesystem.ls(self._path, detail=True)
            except FileNotFoundError:
                return []
        folders = sorted(str(facts["name"]) for facts in found if facts["type"] == "directory")
        names = [folder.rstrip("/").rpartition("/")[2] for folder in folders[:MOST_FOLDERS]]
        return [f"{self._url}/{name}" for name in names if UrlStore(f"{self._url}/{name}").versions()]

    def folder(self, version: Version) -> RemoteFolder:
        """Return the folder with the files of `version`."""
        return RemoteFolder(self._filesystem, f"{self._path}/{version.tag}", f"{self._url}/{version.tag}")

    def upload(self, dataset: Dataset, card: Path, progress: Progress) -> None:
        """Upload `dataset`: `layout.DATASET_PATH` is written last and marks it as complete.

        SHA256SUMS is written first and identifies the upload: the next push of the same files repeats an
        interrupted one, and no existing file is ever deleted.

        Raises:
            BadInputError: the folder holds other files.
            SharingError: the place denies access or cannot be reached.
        """
        version = Version.parse(dataset.description["version"])
        remote = self.folder(version)
        sums = card / SUMS_PATH
        files = {path: dataset.root / path for path in dataset_files(dataset.root)}
        files |= {path.name: path for path in sorted(card.iterdir()) if path != sums}
        files[layout.DATASET_PATH] = files.pop(layout.DATASET_PATH)
        with _explained(self._url):
            self._filesystem.invalidate_cache()
            if not self._is_begun(remote):
                self._put(sums, f"{remote.path}/{SUMS_PATH}")
            for number, (path, file) in enumerate(files.items()):
                # Checked before every file: a push of other values may have begun at the same time.
                self._refuse_others(remote, sums.read_bytes())
                progress(number / len(files), path)
                self._put(file, f"{remote.path}/{path}")
        progress(1.0, f"{len(files)} files")

    def _is_begun(self, remote: RemoteFolder) -> bool:
        """Return whether there are files, but for hidden ones, which a killed push may leave in a folder."""
        found = (str(path).removeprefix(remote.path) for path in self._filesystem.find(remote.path))
        return any("/." not in path for path in found)

    def _put(self, file: Path, path: str) -> None:
        """Upload `file`; in a folder of this machine it is there whole, or not at all."""
        if not self._is_local:
            self._filesystem.put_file(str(file), path)
            return
        with hidden_folder(Path(path)) as folder:
            part = folder / file.name
            self._filesystem.put_file(str(file), str(part))
            sync(part)
            move(part, Path(path))

    def _refuse_others(self, remote: RemoteFolder, sums: bytes) -> None:
        try:
            there = self._filesystem.cat_file(f"{remote.path}/{SUMS_PATH}")
        except FileNotFoundError:
            there = None
        if there != sums:
            raise BadInputError(
                f"{remote.name} exists already and holds something else: other files, or a part of another "
                f"push of this version, stopped or going on right now. Nothing in it is replaced: look at it "
                "and delete it, give the dataset a new version, or push elsewhere."
            )

    def _mark(self, version: Version) -> str:
        return f"{self.folder(version).path}/{layout.DATASET_PATH}"


@contextmanager
def _explained(url: str) -> Iterator[None]:
    """Turn the exceptions of a back end, each of which has its own, into one-line messages."""
    try:
        with writing(Path(url.removeprefix("file://")), place=False):
            yield
    except AstraDataError:
        raise
    except PermissionError as error:
        raise SharingError(f"{url}: no rights to do this ({error}); check the credentials.") from error
    except FileNotFoundError as error:
        raise SharingError(f"{url}: does not exist ({error}); check the spelling.") from error
    except Exception as error:
        raise SharingError(
            f"{url}: {type(error).__name__}: {error}; check the address, the credentials and the network."
        ) from error
