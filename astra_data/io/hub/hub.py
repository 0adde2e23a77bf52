"""Datasets on the Hugging Face Hub: one repository each, whose tags data-<version> never move."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from astra_data.core.errors import AstraDataError, BadInputError, SharingError
from astra_data.core.progress import Progress
from astra_data.dataset import format as layout
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version
from astra_data.io.hub.store import RemoteFolder
from astra_data.io.hub.sums import SUMS_PATH, dataset_files

if TYPE_CHECKING:
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError

KIND = "dataset"


class HubStore:
    """The versions of one dataset in the Hub's repository `repo`, "user/name"."""

    def __init__(self, repo: str) -> None:
        """Take the name of the repository; no request is made."""
        self._repo = repo

    def create(self, card: Path, *, private: bool) -> None:
        """Create the repository unless it exists.

        Args:
            card: a folder with its future README.md, which the Hub validates first.
            private: whether the repository is to be private.

        Raises:
            BadInputError: the Hub rejects the card, or the repository is public and should be private.
            SharingError: the Hub refuses or cannot be reached.
        """
        with _explained(self._repo) as api:
            _validate(api, (card / "README.md").read_text(encoding="utf-8"))
            # None stands for the default of the user or the organization.
            api.create_repo(self._repo, repo_type=KIND, private=private or None, exist_ok=True)
            if private and not api.repo_info(self._repo, repo_type=KIND).private:
                raise BadInputError(
                    f"{self._repo} exists already and is public, expected a private repository. Nothing was "
                    "uploaded: make it private in its settings on the Hub, choose another, or leave out "
                    "--private."
                )

    def versions(self) -> list[Version]:
        """Return the tagged versions, the oldest first."""
        return sorted(self._commits())

    def folder(self, version: Version) -> RemoteFolder:
        """Return the folder with the files of `version`: the commit that its tag names right now."""
        from huggingface_hub import HfFileSystem  # noqa: PLC0415 - slow to import

        filesystem = HfFileSystem(skip_instance_cache=True)
        commit = self._commits()[version]
        return RemoteFolder(filesystem, f"datasets/{self._repo}@{commit}", f"{self._repo}@{version.tag}")

    def upload(self, dataset: Dataset, card: Path, progress: Progress) -> None:
        """Add `dataset`: its files and card, then the tag "v3.0", then the tag that marks it as complete.

        Raises:
            BadInputError: the repository holds another dataset or a newer version.
            SharingError: the Hub refuses or cannot be reached.
        """
        version = Version.parse(dataset.description["version"])
        self._refuse_mixing(dataset, version)
        with _explained(self._repo) as api:
            progress(0.0, "files")
            commit = self._commit(api, dataset, card)
            progress(0.9, "tags")
            tags = api.list_repo_refs(self._repo, repo_type=KIND).tags
            if layout.CODEBASE_VERSION in [tag.name for tag in tags]:
                api.delete_tag(self._repo, tag=layout.CODEBASE_VERSION, repo_type=KIND)
            for tag in (layout.CODEBASE_VERSION, version.tag):
                api.create_tag(self._repo, tag=tag, revision=commit, repo_type=KIND)
        progress(1.0, version.tag)

    def _refuse_mixing(self, dataset: Dataset, version: Version) -> None:
        known = self.versions()
        if not known:
            return
        name = self.folder(known[-1]).description().get("name")
        if name != dataset.description["name"]:
            raise BadInputError(f"{self._repo} holds the dataset {name!r}; choose another repository.")
        if known[-1] > version:
            raise BadInputError(
                f"{self._repo} has {known[-1].tag} already, and main shows the newest version: "
                f"{version.tag} can no longer be added. Push it to another place."
            )

    def _commit(self, api: "HfApi", dataset: Dataset, card: Path) -> str:
        """Replace data/, meta/ and the card by those of `dataset`, in one commit; return its id.

        `upload_folder` would do it in several commits, of which the first might leave a mixture behind.
        """
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete  # noqa: PLC0415 - slow to import

        # If somebody else commits from here on, this commit fails.
        head = api.repo_info(self._repo, repo_type=KIND).sha
        there = api.list_repo_files(self._repo, revision=head, repo_type=KIND)
        if layout.INFO_PATH in there and SUMS_PATH not in there:
            raise BadInputError(
                f"{self._repo} holds a dataset that astra-data did not push; choose another repository."
            )
        files = dataset_files(dataset.root)
        old = [path for path in there if path.startswith(("data/", "meta/")) and path not in files]
        commit = api.create_commit(
            self._repo,
            [
                *(CommitOperationAdd(path, dataset.root / path) for path in files),
                *(CommitOperationDelete(path, is_folder=False) for path in old),
                *(CommitOperationAdd(path.name, path) for path in sorted(card.iterdir())),
            ],
            repo_type=KIND,
            parent_commit=head,
            commit_message=f"Add {dataset.reference}",
        )
        return str(commit.oid)

    def _commits(self) -> dict[Version, str]:
        with _explained(self._repo) as api:
            tags = api.list_repo_refs(self._repo, repo_type=KIND).tags
        versions = ((Version.from_tag(tag.name), tag.target_commit) for tag in tags)
        return {version: commit for version, commit in versions if version}


def _validate(api: "HfApi", card: str) -> None:
    """Validate `card` on the Hub, before a repository is created for it."""
    from huggingface_hub import get_session, get_token, hf_raise_for_status  # noqa: PLC0415 - slow to import

    token = get_token()
    answer = get_session().post(
        f"{api.endpoint}/api/validate-yaml",
        json={"content": card, "repoType": KIND},
        headers={"Authorization": f"Bearer {token}"} if token else {},
    )
    if answer.status_code == 400:
        faults = "; ".join(str(fault.get("message")) for fault in answer.json().get("errors", []))
        raise ValueError(f"faults in the card: {faults}")
    hf_raise_for_status(answer)


@contextmanager
def _explained(repo: str) -> Iterator["HfApi"]:
    """Yield the Hub's API; turn its exceptions into one-line messages."""
    from huggingface_hub import HfApi  # noqa: PLC0415 - slow to import
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError  # noqa: PLC0415 - slow to import

    try:
        yield HfApi()
    except AstraDataError:
        raise
    except HfHubHTTPError as error:
        raise SharingError(f"{repo} on the Hugging Face Hub: {_refusal(error)}") from error
    except HFValidationError as error:
        raise BadInputError(f"{repo} is not a valid repository name on the Hub: {error}") from error
    except ValueError as error:
        raise BadInputError(f"{repo}: the Hugging Face Hub rejects this: {error}") from error
    except Exception as error:
        # A failed upload raises the exception of its transfer, wrapped or not.
        cause = error.__cause__ or error
        if isinstance(cause, HfHubHTTPError):
            raise SharingError(f"{repo} on the Hugging Face Hub: {_refusal(cause)}") from error
        raise SharingError(
            f"{repo} on the Hugging Face Hub cannot be reached ({type(cause).__name__}: {cause}); "
            "check the network, then run the same command again."
        ) from error


def _refusal(error: "HfHubHTTPError") -> str:
    from huggingface_hub.errors import RepositoryNotFoundError  # noqa: PLC0415 - slow to import

    status = error.response.status_code
    if isinstance(error, RepositoryNotFoundError):
        return "no such dataset, or no rights to see it; check the name and log in with `hf auth login`."
    if status in (401, 403):
        return "no rights to do this; log in with `hf auth login` and a token that may write."
    if status in (409, 412):
        return "it was changed by somebody else at the same time; run the same command again."
    return f"it answered {status}: {error.server_message or error}"
