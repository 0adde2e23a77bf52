"""Download a version of a shared dataset; an interrupted download is continued."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from astra_data.core.durable import folder_for, held, publish
from astra_data.core.errors import AstraDataError, BadInputError, CorruptDatasetError, SharingError
from astra_data.core.progress import Progress, silent
from astra_data.dataset.description import NAME
from astra_data.dataset.doctor.check import check
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version, home_of, open_dataset
from astra_data.io.hub.address import Hub, is_address, parse_source
from astra_data.io.hub.fetch import fetch, refuse_planted
from astra_data.io.hub.hub import HubStore
from astra_data.io.hub.store import RemoteFolder, Store
from astra_data.io.hub.sums import SUMS_PATH, Listed, altered, parse_sums
from astra_data.io.hub.urls import UrlStore

MOST_BYTES = 100 * 10**9
"""Most bytes that are downloaded unless more are asked for; a robot's logs stay far below."""


def pull(
    source: str,
    *,
    out: Path | None = None,
    version: str | None = None,
    max_bytes: int = MOST_BYTES,
    progress: Progress = silent,
) -> Dataset:
    """Download a version of the dataset at `source`; if it is there already, compare it file by file.

    Files are downloaded to a hidden folder beside the dataset's, from which an interrupted pull continues.
    The dataset appears there once it is complete and its values are verified.

    Args:
        source: "user/name" or "hf://datasets/user/name" on the Hugging Face Hub, or the URL of the dataset's
            folder, whose last part is its name; "@data-1.2.0" after it names a version.
        out: the dataset's folder, by default its place at home.
        version: such as "1.2.0", by default the newest.
        max_bytes: the most bytes of all its files; a larger dataset is refused before it is downloaded.
        progress: called with the fraction done.

    Raises:
        BadInputError: the source has no such version or is a folder of datasets, or `out` holds something
            else.
        CorruptDatasetError: `out` holds this dataset, altered.
        SharingError: the source cannot be reached, denies access, is too large, or is not a valid dataset.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import pull, push
        >>> pull(push("walks", "./shared"), out=Path("copy")).reference
        'walks@data-1.0.0'
    """
    where, named = parse_source(source)
    asked = Version.parse(version.removeprefix("data-")) if version else named
    if named and asked != named:
        raise BadInputError(f"{source} names {named.tag}, but the version asked for is {version}.")
    if isinstance(where, Hub) and not source.startswith("hf://") and Path(where.repo).is_dir():
        raise BadInputError(
            f"{source} is a folder here: pull ./{source}, or hf://datasets/{source} of the Hub"
        )
    store: Store = HubStore(where.repo) if isinstance(where, Hub) else UrlStore(where.url)
    known = store.versions()
    if not known:
        if isinstance(store, UrlStore) and (inside := store.datasets()):
            raise BadInputError(f"{where} is a folder of datasets: pull one of {', '.join(inside)}")
        raise SharingError(
            f"{where} has no dataset of astra-data: no tag or folder such as data-1.2.0. "
            "A plain LeRobot dataset is opened with lerobot; otherwise check the spelling."
        )
    if asked and asked not in known:
        listed = ", ".join(one.tag for one in known)
        raise BadInputError(f"{where} has no version {asked.tag}; it has {listed}.")
    chosen = asked or known[-1]
    remote = store.folder(chosen)
    description = remote.description()
    name, called = description.get("name"), description.get("version")
    if not isinstance(name, str) or not NAME.fullmatch(name) or called != str(chosen):
        raise SharingError(f"{remote.name} calls itself {name!r} {called!r}; it cannot be trusted.")
    target = home_of(description) if out is None else out
    sums = parse_sums(remote.read_text(SUMS_PATH), remote.name)
    if target.exists():
        dataset = _present(target, description, sums)
        progress(1.0, f"it is there already, and whole: {len(sums)} files were compared")
        return dataset
    try:
        with folder_for(target):
            _fetch_all(remote, sums, target, description, max_bytes, progress)
    except OSError as error:
        raise BadInputError(f"{target} cannot be written ({error}); choose another folder.") from error
    return Dataset.open(target)


def opened(data: str | Path) -> Dataset:
    """Open a dataset here, or pull it.

    Raises:
        BadInputError, CorruptDatasetError, SharingError: as `open_dataset` and `pull`.
    """
    return pull(str(data)) if is_address(data) else open_dataset(data)


def _fetch_all(
    remote: RemoteFolder,
    sums: Mapping[str, Listed],
    target: Path,
    description: Mapping[str, Any],
    max_bytes: int,
    progress: Progress,
) -> None:
    _refuse_sizes(remote, sums, max_bytes)
    partial = target.with_name(f".{target.name}.pull-{description['version']}")
    partial.mkdir(parents=True, exist_ok=True)
    refuse_planted(partial)
    with held(partial) as ours:
        if not ours:
            raise BadInputError(f"{target} is being pulled right now; wait or choose another folder.")
        for number, (path, listed) in enumerate(sums.items()):
            progress(number / len(sums), path)
            fetch(remote, path, partial, listed)
        for file in [file for file in partial.rglob("*") if file.is_file()]:
            if file.relative_to(partial).as_posix() not in sums:
                file.unlink()
        _check(partial, sums, description, remote.name)
        publish(partial, target)
    progress(1.0, f"{len(sums)} files")


def _refuse_sizes(remote: RemoteFolder, sums: Mapping[str, Listed], max_bytes: int) -> None:
    """Compare the sizes of the files with those listed, and their sum with `max_bytes`."""
    found = {path: facts.get("size") for path, facts in remote.files().items()}
    wrong = [
        f"{path} has {found[path]} bytes, listed are {listed.size}"
        for path, listed in sums.items()
        if found.get(path) is not None and listed.size != found[path]
    ]
    if wrong:
        raise SharingError(f"{remote.name} was altered: {'; '.join(wrong)}. Nothing was downloaded.")
    total = sum(listed.size for listed in sums.values())
    if total > max_bytes:
        raise SharingError(
            f"{remote.name} has {total} bytes, of which at most {max_bytes} are taken; nothing was "
            "downloaded. If you trust it, pass a larger --max-bytes."
        )


def _present(target: Path, description: Mapping[str, Any], sums: Mapping[str, Listed]) -> Dataset:
    """Return the dataset in folder `target`, which must be the one described, whole."""
    changed = altered(target, sums)
    try:
        dataset = Dataset.open(target)
        is_other = dataset.content_hash != description.get("content_hash")
    except CorruptDatasetError as error:
        if len(changed) < len(sums):
            raise CorruptDatasetError(f"{error} Delete it, or pull to another folder.") from error
        is_other = True
    except AstraDataError:
        is_other = True
    if is_other:
        raise BadInputError(
            f"{target} exists already and holds something else; delete it or choose another folder."
        )
    if changed:
        raise CorruptDatasetError(
            f"{target} was altered: it differs from what is shared in {', '.join(changed)}. "
            "Delete it, or pull to another folder."
        )
    return dataset


def _check(folder: Path, sums: Mapping[str, Listed], description: Mapping[str, Any], name: str) -> None:
    """Check that the downloaded files are the complete dataset; they may have been written by anybody."""
    try:
        dataset = Dataset.open(folder)
        faults = check(folder).faults
        outside = [str(path) for path in dataset.paths if path.relative_to(folder).as_posix() not in sums]
        if dataset.content_hash != description.get("content_hash"):
            faults.append("its description changed during the download")
    except Exception as error:
        shutil.rmtree(folder)
        raise SharingError(f"{name} is not a complete dataset: {error}") from error
    faults += [f"{path} does not belong to it" for path in outside]
    if faults:
        shutil.rmtree(folder)
        raise SharingError(f"{name} is not a complete dataset: {'; '.join(faults)}.")
