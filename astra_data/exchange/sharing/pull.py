"""Download a version of a shared dataset; an interrupted download is continued."""

import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from astra_data.core.errors import AstraDataError, BadInputError, SharingError
from astra_data.core.lock import held
from astra_data.core.progress import Progress, silent
from astra_data.dataset import Dataset
from astra_data.dataset.atomic import publish
from astra_data.dataset.description import NAME
from astra_data.dataset.doctor.check import check
from astra_data.dataset.versions import Version, place
from astra_data.exchange.sharing.address import Hub, parse_source
from astra_data.exchange.sharing.fetch import fetch
from astra_data.exchange.sharing.hub import HubStore
from astra_data.exchange.sharing.store import RemoteFolder, Store
from astra_data.exchange.sharing.sums import SUMS_PATH, parse_sums
from astra_data.exchange.sharing.urls import UrlStore


def pull(
    source: str, *, out: Path | None = None, version: str | None = None, progress: Progress = silent
) -> Dataset:
    """Download a version of the dataset at `source`; do nothing if it is there already.

    Files are downloaded to a hidden folder beside the dataset's, from which an interrupted pull continues.
    The dataset appears there once it is complete and its values are verified.

    Args:
        source: "user/name" or "hf://datasets/user/name" on the Hugging Face Hub, or the URL of the dataset's
            folder, whose last part is its name; "@data-1.2.0" after it names a version.
        out: the dataset's folder, by default its place at home.
        version: such as "1.2.0", by default the newest.
        progress: called with the fraction done.

    Raises:
        BadInputError: the source has no such version, or the folder holds something else.
        SharingError: the source cannot be reached, denies access, or is not a valid dataset.

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
    store: Store = HubStore(where.repo) if isinstance(where, Hub) else UrlStore(where.url)
    known = store.versions()
    if not known:
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
    target = place(description) if out is None else out
    if target.exists():
        return _present(target, description)
    sums = parse_sums(remote.read_text(SUMS_PATH), remote.name)
    try:
        _fetch_all(remote, sums, target, description, progress)
    except OSError as error:
        raise BadInputError(f"{target} cannot be written ({error}); choose another folder.") from error
    return Dataset.open(target)


def _fetch_all(
    remote: RemoteFolder,
    sums: Mapping[str, str],
    target: Path,
    description: Mapping[str, Any],
    progress: Progress,
) -> None:
    partial = target.with_name(f".{target.name}.pull-{description['version']}")
    partial.mkdir(parents=True, exist_ok=True)
    with held(partial) as ours:
        if not ours:
            raise BadInputError(f"{target} is being pulled right now; wait or choose another folder.")
        for number, (path, digest) in enumerate(sums.items()):
            progress(number / len(sums), path)
            fetch(remote, path, partial, digest)
        for file in [file for file in partial.rglob("*") if file.is_file()]:
            if file.relative_to(partial).as_posix() not in sums:
                file.unlink()
        _check(partial, sums, description, remote.name)
        publish(partial, target)
    progress(1.0, f"{len(sums)} files")


def _present(target: Path, description: Mapping[str, Any]) -> Dataset:
    """Return the dataset in folder `target`, which must be the one described."""
    with suppress(AstraDataError):
        dataset = Dataset.open(target)
        if dataset.content_hash == description.get("content_hash"):
            return dataset
    raise BadInputError(
        f"{target} exists already and holds something else; delete it or choose another folder."
    )


def _check(folder: Path, sums: Mapping[str, str], description: Mapping[str, Any], name: str) -> None:
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
