"""The places where datasets are shared: a repository on the Hub, or a folder at any URL, with files and SHA256SUMS."""

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from astra_data.core.durable import file_digest, sync_tree, write_file, writing
from astra_data.core.errors import AstraDataError, BadInputError, SharingError, how_to_install
from astra_data.core.progress import Progress
from astra_data.dataset import format as layout
from astra_data.dataset.description import VERSION
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version

if TYPE_CHECKING:
    from huggingface_hub import HfApi

KIND = "dataset"
TEXT_BYTES = 2**26  # most bytes of a description or of SHA256SUMS: of some hundred thousand recordings or files
BLOCK_BYTES = 2**24  # bytes per request
EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs"}  # protocol → the extra that is needed for it

SUMS_PATH = "SHA256SUMS"
_NUMBERED = r"chunk-[0-9]{3,}/file-[0-9]{3,}\.parquet"
_PATH = re.compile(
    rf"(data|meta/episodes)/{_NUMBERED}"
    r"|videos/(?!\.\.?/)[\w. -]+/chunk-[0-9]{3,}/file-[0-9]{3,}\.mp4"
    r"|meta/(info\.json|stats\.json|tasks\.parquet)"
    r"|meta/astra/[a-z_]+\.(json|parquet|safetensors)"
)  # paths of the files of a dataset, by the names of the format; none of them leads out of its folder
_LINE = re.compile(r"([0-9a-f]{64}) [ *](.+)")

_WORD = r"[A-Za-z0-9][A-Za-z0-9._-]*"
_HUB = re.compile(rf"(hf://datasets/)?(?P<repo>{_WORD}/{_WORD})/?")
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://.+")
_VERSION = re.compile(rf"[@/](data-)?(?P<version>{VERSION.pattern})/?$")


def dataset_files(root: Path) -> list[str]:
    """List the files that belong to the dataset in folder `root`, relative to it, and no others."""
    # Such globs follow links, ** would not.
    places = ("data/*/*", "videos/*/*/*", "meta/*", "meta/astra/*", "meta/episodes/*/*")
    paths = [path.relative_to(root).as_posix() for place in places for path in root.glob(place) if path.is_file()]
    return sorted(path for path in paths if _PATH.fullmatch(path))


def make_sums(root: Path) -> str:
    """Return SHA256SUMS of the dataset in folder `root`."""
    return "".join(f"{file_digest(root / path)}  {path}\n" for path in dataset_files(root))


def parse_sums(text: str, source: str) -> dict[str, str]:
    """Read SHA256SUMS: file path to sha256; a SharingError lists malformed lines and paths of no dataset."""
    sums: dict[str, str] = {}
    faults = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not (found := _LINE.fullmatch(line)):
            faults.append(f"line {number} is not a sha256 with a path")
        elif not _PATH.fullmatch(found[2]):
            expected = "expected one of a dataset's files, within data/, meta/ or videos/"
            faults.append(f"line {number} has the path {found[2]!r}, {expected}")
        elif found[2] in sums:
            faults.append(f"line {number} lists {found[2]} again")
        else:
            sums[found[2]] = found[1]
    if faults:
        raise SharingError(f"{source}: {SUMS_PATH} cannot be trusted: {'; '.join(faults)}. Nothing was downloaded.")
    return sums


def altered(root: Path, sums: Mapping[str, str]) -> list[str]:
    """Return which files of `sums` are missing from folder `root` or differ."""
    return [path for path, digest in sums.items() if not (root / path).is_file() or file_digest(root / path) != digest]


def parse_place(text: str) -> "HubStore | UrlStore":
    """Read "user/name", "hf://datasets/user/name", a URL, or a folder that begins with a dot, / or ~."""
    if hub := _HUB.fullmatch(text):
        return HubStore(hub["repo"])
    if text.startswith(("/", "./", "../", "~/")):
        return UrlStore(f"file://{Path(text).expanduser().absolute()}")
    if not _URL.fullmatch(text) or text.startswith("hf://"):
        others = "a URL such as s3://bucket/folder or gs://bucket/folder, or a folder such as ./shared or /shared"
        raise BadInputError(f"{text}: expected user/name or hf://datasets/user/name for the Hugging Face Hub, {others}")
    return UrlStore(text.rstrip("/"))


def parse_source(text: str) -> "tuple[HubStore | UrlStore, Version | None]":
    """Read a place and, if named, a version: "user/name@data-1.2.0", "s3://…/name/data-1.2.0"."""
    named = _VERSION.search(text)
    return parse_place(text[: named.start()] if named else text), Version.parse(named["version"]) if named else None


def is_address(data: str | Path) -> bool:
    """Return whether `data` is an address to pull from, such as user/name or s3://…, and no folder here."""
    if Path(data).is_dir():
        return False
    return "://" in str(data) or (len(Path(data).parts) == 2 and not str(data).startswith((".", "/")))


@dataclass(frozen=True)
class RemoteFolder:
    """The files of one version, wherever they are; of what a stranger put there, only plain files are read."""

    filesystem: Any  # of fsspec
    path: str
    name: str  # of the version, for messages

    def facts(self, path: str) -> dict[str, Any]:
        """Return what the file system knows of a file, such as its "size"; empty without one; refuse links, pipes."""
        with explained(self.name):
            try:
                facts = dict(self.filesystem.info(f"{self.path}/{path}"))
            except FileNotFoundError:
                return {}
            whole = os.path.join(os.path.realpath(self.path), path)
            is_linked = self._is_here and os.path.realpath(f"{self.path}/{path}") != whole
        if facts.get("type") != "file" or facts.get("islink") or is_linked:
            raise SharingError(f"{self.name}: {path} is a link, a device or a pipe, expected a file.")
        return facts

    def blocks(self, path: str, most: int) -> Iterator[bytes]:
        """Yield the bytes of the file `path`, at most `most` in all, in blocks."""
        with self.filesystem.open(f"{self.path}/{path}", "rb", block_size=BLOCK_BYTES, cache_type="none") as source:
            while most > 0 and (block := source.read(min(BLOCK_BYTES, most))):
                most -= len(block)
                yield block

    def read_text(self, path: str) -> str:
        """Return the text of the small file `path`, or raise a SharingError."""
        if not self.facts(path):
            raise SharingError(f"{self.name} has no {path}: it was not pushed by astra-data, or is damaged.")
        with explained(f"{self.name}: {path}"):
            content = b"".join(self.blocks(path, TEXT_BYTES + 1))
            if len(content) > TEXT_BYTES:
                raise SharingError(f"{self.name}: {path} is larger than {TEXT_BYTES // 2**20} MB.")
            return content.decode()

    def description(self) -> dict[str, Any]:
        """Return meta/astra/dataset.json, or raise a SharingError."""
        text = self.read_text(layout.DATASET_PATH)
        try:
            return dict(json.loads(text))
        except (RecursionError, TypeError, ValueError) as error:
            raise SharingError(f"{self.name}: {layout.DATASET_PATH} is not a JSON object ({error}).") from error

    def differs(self, path: str, file: Path, digest: str) -> bool:
        """Return whether a file is missing here or other than `file`, as far as is known without a download."""
        if not (facts := self.facts(path)) or facts.get("size") not in (None, file.stat().st_size):
            return True
        found = file_digest(Path(self.path, path)) if self._is_here else (facts.get("lfs") or {}).get("sha256")
        return found not in (None, digest)

    @property
    def _is_here(self) -> bool:
        protocol = self.filesystem.protocol
        return "file" in ((protocol,) if isinstance(protocol, str) else protocol)


@dataclass(frozen=True)
class HubStore:
    """The repository `repo`, "user/name", on the Hugging Face Hub, whose tags data-<version> never move."""

    repo: str

    def __str__(self) -> str:
        return f"hf://datasets/{self.repo}"

    def create(self, *, private: bool) -> None:
        """Create the repository unless it exists; raise BadInputError if it is public but should not be."""
        with self._api() as api:
            # None stands for the default of the user or the organization.
            api.create_repo(self.repo, repo_type=KIND, private=private or None, exist_ok=True)
            if private and not api.repo_info(self.repo, repo_type=KIND).private:
                advice = "make it private in its settings on the Hub, choose another, or leave out --private."
                fault = f"{self.repo} exists already and is public, expected a private repository"
                raise BadInputError(f"{fault}. Nothing was uploaded: {advice}")

    def versions(self) -> list[Version]:
        """Return the tagged versions, the oldest first."""
        return sorted(self._commits())

    def folder(self, version: Version) -> RemoteFolder:
        """Return the folder with the files of `version`: the commit that its tag names right now."""
        from huggingface_hub import HfFileSystem  # noqa: PLC0415 - slow to import

        path = f"datasets/{self.repo}@{self._commits()[version]}"
        return RemoteFolder(HfFileSystem(skip_instance_cache=True), path, f"{self.repo}@{version.tag}")

    def upload(self, dataset: Dataset, card: Path, progress: Progress) -> None:
        """Add `dataset`, its files and the `card`, then the tag "v3.0", then the tag that marks it as complete."""
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete  # noqa: PLC0415 - slow to import

        version = Version.parse(dataset.description["version"])
        if known := self.versions():
            name = self.folder(known[-1]).description().get("name")
            if name != dataset.description["name"]:
                raise BadInputError(f"{self.repo} holds the dataset {name!r}; choose another repository.")
            if known[-1] > version:
                why = f"main shows the newest version: {version.tag} can no longer be added. Push it to another place."
                raise BadInputError(f"{self.repo} has {known[-1].tag} already, and {why}")
        with self._api() as api:
            progress(0.0, "files")
            head = api.repo_info(self.repo, repo_type=KIND).sha  # if somebody commits from here on, this commit fails
            there = api.list_repo_files(self.repo, revision=head, repo_type=KIND)
            if layout.INFO_PATH in there and SUMS_PATH not in there:
                raise BadInputError(f"{self.repo} holds a dataset that astra-data did not push; choose another one.")
            files = dataset_files(dataset.root)
            old = [path for path in there if path.startswith(("data/", "meta/", "videos/")) and path not in files]
            commit = api.create_commit(
                self.repo,
                [
                    *(CommitOperationAdd(path, dataset.root / path) for path in files),
                    *(CommitOperationDelete(path, is_folder=False) for path in old),
                    *(CommitOperationAdd(path.name, path) for path in sorted(card.iterdir())),
                ],
                repo_type=KIND,
                parent_commit=head,
                commit_message=f"Add {dataset.reference}",
            )
            progress(0.9, "tags")
            tags = api.list_repo_refs(self.repo, repo_type=KIND).tags
            if layout.CODEBASE_VERSION in [tag.name for tag in tags]:
                api.delete_tag(self.repo, tag=layout.CODEBASE_VERSION, repo_type=KIND)
            for tag in (layout.CODEBASE_VERSION, version.tag):
                api.create_tag(self.repo, tag=tag, revision=commit.oid, repo_type=KIND)
        progress(1.0, version.tag)

    def _commits(self) -> dict[Version, str]:
        with self._api() as api:
            tags = api.list_repo_refs(self.repo, repo_type=KIND).tags
        versions = ((Version.from_tag(tag.name), tag.target_commit) for tag in tags)
        return {version: commit for version, commit in versions if version}

    @contextmanager
    def _api(self) -> Iterator["HfApi"]:
        from huggingface_hub import HfApi  # noqa: PLC0415 - slow to import

        with explained(f"{self.repo} on the Hugging Face Hub"):
            yield HfApi()


class UrlStore:
    """The versions of one dataset below a URL; a version counts once its `layout.DATASET_PATH` exists."""

    def __init__(self, url: str) -> None:
        """Take the folder `url`, whose last part is the dataset's name."""
        import fsspec  # noqa: PLC0415 - slow to import

        self.url = url
        protocol = url.partition("://")[0].lower()
        self._is_local = protocol in ("file", "local")
        with explained(url):
            try:
                self._filesystem, self._path = fsspec.core.url_to_fs(url)
            except ValueError as error:
                raise BadInputError(f"{url}: expected a URL such as s3://bucket/folder ({error})") from error
            except ImportError as error:
                how = how_to_install(EXTRAS[protocol]) if protocol in EXTRAS else error
                raise BadInputError(f"{url}: the package for {protocol}:// is not installed: {how}") from error

    def __str__(self) -> str:
        return self.url

    def versions(self) -> list[Version]:
        """Return the complete versions, the oldest first."""
        with explained(self.url):
            self._filesystem.invalidate_cache()
            found = (version for name in self.names() if (version := Version.from_tag(name)))
            return sorted(v for v in found if self._filesystem.exists(f"{self.folder(v).path}/{layout.DATASET_PATH}"))

    def names(self) -> list[str]:
        """Return the names of the folders in it."""
        try:
            found = self._filesystem.ls(self._path, detail=True)
        except FileNotFoundError:
            return []
        paths = (str(facts["name"]).rstrip("/") for facts in found if facts["type"] == "directory")
        return sorted({path.rpartition("/")[2] for path in paths})

    def folder(self, version: Version) -> RemoteFolder:
        """Return the folder with the files of `version`."""
        return RemoteFolder(self._filesystem, f"{self._path}/{version.tag}", f"{self.url}/{version.tag}")

    def upload(self, dataset: Dataset, card: Path, progress: Progress) -> None:
        """Upload `dataset` and its card, `layout.DATASET_PATH`, which marks it as complete, last; replace no other."""
        remote = self.folder(Version.parse(dataset.description["version"]))
        sums = (card / SUMS_PATH).read_bytes()
        files = {path: dataset.root / path for path in dataset_files(dataset.root)}
        files |= {path.name: path for path in sorted(card.iterdir()) if path.name != SUMS_PATH}
        mark = files.pop(layout.DATASET_PATH)
        with explained(self.url):
            self._filesystem.invalidate_cache()
            # Hidden files may be left in a folder by a killed push.
            there = (str(path).removeprefix(remote.path) for path in self._filesystem.find(remote.path))
            if not any("/." not in path for path in there):
                self._write(f"{remote.path}/{SUMS_PATH}", sums)
            for number, (path, file) in enumerate(files.items()):
                # Checked before every file: a push of other values may have begun at the same time.
                self._refuse_others(remote, sums)
                progress(number / len(files), path)
                target = f"{remote.path}/{path}"
                if self._is_local:
                    Path(target).parent.mkdir(parents=True, exist_ok=True)
                self._filesystem.put_file(str(file), target)
            if self._is_local:
                sync_tree(Path(remote.path))
            self._refuse_others(remote, sums)
            self._write(f"{remote.path}/{layout.DATASET_PATH}", mark.read_bytes())
        progress(1.0, f"{len(files) + 1} files")

    def _write(self, path: str, content: bytes) -> None:
        """Write a small file; in a folder of this machine it is there whole, or not at all."""
        if self._is_local:
            write_file(Path(path), content)
        else:
            self._filesystem.pipe_file(path, content)

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


@contextmanager
def explained(place: str) -> Iterator[None]:
    """Turn the exceptions of the Hub and of file systems into one-line messages."""
    try:
        with writing(Path(place.removeprefix("file://")), place=False):
            yield
    except AstraDataError:
        raise
    except PermissionError as error:
        raise SharingError(f"{place}: no rights to do this ({error}); check the credentials.") from error
    except (FileNotFoundError, NotADirectoryError) as error:
        advice = "check the spelling, or delete a version whose files are missing and push it again."
        raise SharingError(f"{place}: does not exist or is no folder ({error}); {advice}") from error
    except Exception as error:
        advice = "check the address, the credentials and the network, then run the same command again."
        other = SharingError(f"{place}: {type(error).__name__}: {error}; {advice}")
        raise (_of_the_hub(place, error) if "Hugging Face Hub" in place else None) or other from error


def _of_the_hub(place: str, error: Exception) -> AstraDataError | None:
    from huggingface_hub import errors  # noqa: PLC0415 - slow to import

    # A failed upload raises the exception of its transfer, wrapped or not.
    cause = error if isinstance(error, errors.HfHubHTTPError) else error.__cause__ or error
    if isinstance(cause, errors.HFValidationError):
        return BadInputError(f"{place}: not a valid repository name: {cause}")
    if isinstance(error, ValueError):
        return BadInputError(f"{place} rejects this: {error}")
    if not isinstance(cause, errors.HfHubHTTPError):
        return None
    status = cause.response.status_code
    why = f"it answered {status}: {cause.server_message or cause}"
    if isinstance(cause, errors.RepositoryNotFoundError):
        why = "no such dataset, or no rights to see it; check its name, log in with `hf auth login`."
    elif status in (401, 403):
        why = "no rights to do this; log in with `hf auth login` and a token that may write."
    elif status in (409, 412):
        why = "it was changed by somebody else at the same time; run the same command again."
    return SharingError(f"{place}: {why}")
