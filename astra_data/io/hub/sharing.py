"""Push a version of a dataset, and pull one; an interrupted push or pull is continued by the next."""

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from astra_data.core.config import load_recipe
from astra_data.core.durable import folder_for, held, publish, writing
from astra_data.core.errors import AstraDataError, BadInputError, CorruptDatasetError, SharingError
from astra_data.core.progress import Progress, silent
from astra_data.dataset.description import NAME
from astra_data.dataset.doctor.check import check
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version, home_of, open_dataset
from astra_data.io.hub import stores

MOST_BYTES = 100 * 10**9  # most bytes that are downloaded unless more are asked for; a robot's logs stay far below
MOST_NAMED = 20  # folders in which datasets are looked for, each with a request of its own


def push(
    dataset: str | Path,
    destination: str,
    *,
    notes: Path | None = None,
    private: bool = False,
    progress: Progress = silent,
) -> str:
    """Upload `dataset` with its card to `destination`; if it is there already, compare it instead.

    Args:
        dataset: a folder, name@data-1.2.0, or name for the newest at home.
        destination: "user/name" or "hf://datasets/user/name" on the Hugging Face Hub, or any URL that fsspec
            knows, below which `<name>/data-<version>/` is made.
        notes: TOML file with the hand-written part of the card, see `Notes`.
        private: create the repository on the Hub as private, and refuse one that is public.
        progress: called with the fraction done.

    Returns:
        the source from which `pull` downloads it, with its version.

    Example:
        >>> from astra_data import push
        >>> push("walks", "./shared").rpartition("/shared/")[2]
        'walks@data-1.0.0'
    """
    from astra_data.io.hub.card import Notes, write_card  # noqa: PLC0415 - draws, unlike pull

    place = stores.parse_place(destination)
    _refuse_folder(place, destination, "push to")
    local = open_dataset(dataset)
    if local.recorded is not None:
        command = f"`astra-data subset {local.root} --percent 100`"
        raise BadInputError(f"{local.root} was recorded by LeRobot: make a dataset of it first, with {command}")
    written = load_recipe(notes, Notes) if notes else Notes()
    if isinstance(place, stores.UrlStore):
        if private:
            raise BadInputError(f"{place}: private is for the Hugging Face Hub; elsewhere, set permissions there.")
        place = stores.UrlStore(f"{place}/{local.description['name']}")
    if faults := check(local.root).faults:
        raise CorruptDatasetError(f"{local.root} was altered: {'; '.join(faults)}. Restore it from a copy.")
    version = Version.parse(local.description["version"])
    if isinstance(place, stores.HubStore):
        place.create(private=private)
    if version in place.versions():
        _refuse_change(place.folder(version), local)
    else:
        with TemporaryDirectory() as folder:
            card = Path(folder)
            write_card(local, card / "README.md", written, source=str(place))
            (card / stores.SUMS_PATH).write_text(stores.make_sums(local.root), encoding="utf-8")
            place.upload(local, card, progress)
    return f"{place}@{version.tag}"


def _refuse_folder(place: object, given: str, action: str) -> None:
    if isinstance(place, stores.HubStore) and not given.startswith("hf://") and Path(place.repo).is_dir():
        raise BadInputError(f"{given} is a folder here: {action} ./{given}, or hf://datasets/{given} of the Hub")


def _refuse_change(there: stores.RemoteFolder, local: Dataset) -> None:
    ours = stores.parse_sums(stores.make_sums(local.root), str(local.root))
    listed = stores.parse_sums(there.read_text(stores.SUMS_PATH), there.name)
    if others := sorted(path for path in ours.keys() | listed if ours.get(path) != listed.get(path)):
        fault = f"{there.name} holds other values or was altered: {stores.SUMS_PATH} there differs in"
        advice = "Versions never change: make it again with another --name, or push elsewhere."
        raise BadInputError(f"{fault} {', '.join(others)}. {advice}")
    if changed := [path for path, digest in ours.items() if there.differs(path, local.root / path, digest)]:
        fault = f"{there.name} was altered: {', '.join(changed)} there differ from {stores.SUMS_PATH}"
        raise SharingError(f"{fault}. Delete this version there and push it again, or push elsewhere.")


def pull(
    source: str,
    *,
    out: Path | None = None,
    version: str | None = None,
    max_bytes: int = MOST_BYTES,
    progress: Progress = silent,
) -> Dataset:
    """Download a version of the dataset at `source`; if it is there already, compare it file by file.

    Files are downloaded to a hidden folder beside the dataset's; those that are whole are not downloaded
    again after an interruption. The dataset appears once it is complete and its values are verified.

    Args:
        source: "user/name" or "hf://datasets/user/name" on the Hugging Face Hub, or the URL of the dataset's
            folder, whose last part is its name; "@data-1.2.0" after it names a version.
        out: the dataset's folder, by default its place at home.
        version: such as "1.2.0", by default the newest.
        max_bytes: the most bytes of all its files; a larger dataset is refused before it is downloaded.
        progress: called with the fraction done.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import pull, push
        >>> pull(push("walks", "./shared"), out=Path("copy")).reference
        'walks@data-1.0.0'
    """
    place, named = stores.parse_source(source)
    asked = Version.parse(version.removeprefix("data-")) if version else named
    if named and asked != named:
        raise BadInputError(f"{source} names {named.tag}, but the version asked for is {version}.")
    _refuse_folder(place, source, "pull")
    known = place.versions()
    if not known:
        names = place.names()[:MOST_NAMED] if isinstance(place, stores.UrlStore) else []
        if inside := [f"{place}/{one}" for one in names if stores.UrlStore(f"{place}/{one}").versions()]:
            raise BadInputError(f"{place} is a folder of datasets: pull one of {', '.join(inside)}")
        advice = "A plain LeRobot dataset is opened with lerobot; otherwise check the spelling."
        raise SharingError(f"{place} has no dataset of astra-data: no tag or folder such as data-1.2.0. {advice}")
    if asked and asked not in known:
        listed = ", ".join(one.tag for one in known)
        raise BadInputError(f"{place} has no version {asked.tag}; it has {listed}.")
    chosen = asked or known[-1]
    remote = place.folder(chosen)
    description = remote.description()
    name, called = description.get("name"), description.get("version")
    if not isinstance(name, str) or not NAME.fullmatch(name) or called != str(chosen):
        raise SharingError(f"{remote.name} calls itself {name!r} {called!r}; it cannot be trusted.")
    target = home_of(description) if out is None else out
    sums = stores.parse_sums(remote.read_text(stores.SUMS_PATH), remote.name)
    if target.exists():
        dataset = _present(target, description, sums)
        progress(1.0, f"it is there already, and whole: {len(sums)} files were compared")
        return dataset
    too_large = f"of which at most {max_bytes} are taken. If you trust it, pass a larger --max-bytes."
    total = sum(remote.facts(path).get("size") or 0 for path in sums)
    if total > max_bytes:
        raise SharingError(f"{remote.name} has {total} bytes, {too_large}")
    partial = target.with_name(f".{target.name}.pull-{description['version']}")
    with writing(target), folder_for(target), _begun(partial, sums):
        for number, path in enumerate(stores.altered(partial, sums)):
            progress(number / len(sums), path)
            max_bytes -= fetch(remote, path, partial, max_bytes + 1)
            if max_bytes < 0:  # where the place does not know sizes
                (partial / path).unlink()
                raise SharingError(f"{remote.name} has more bytes, {too_large}")
        _check(partial, sums, description, remote.name)
        publish(partial, target)
    progress(1.0, f"{len(sums)} files")
    return Dataset.open(target)


def opened(data: str | Path) -> Dataset:
    """Open a dataset here, or pull it."""
    return pull(str(data)) if stores.is_address(data) else open_dataset(data)


@contextmanager
def _begun(partial: Path, sums: Mapping[str, str]) -> Iterator[None]:
    """Hold the folder of an unfinished download, without what is not of it; refuse links, devices and pipes."""
    partial.mkdir(parents=True, exist_ok=True)
    for entry in [partial, *partial.rglob("*")]:
        is_plain = entry.is_file() and entry.lstat().st_nlink == 1
        if entry.is_symlink() or not (entry.is_dir() or is_plain):
            advice = f"delete {partial}, then run the same command again."
            raise SharingError(f"{entry} is a link, a device or a pipe, which no pull leaves there: {advice}")
    with held(partial) as ours:
        if not ours:
            raise BadInputError(f"{partial} is being pulled right now; wait or choose another folder.")
        for file in [file for file in partial.rglob("*") if file.is_file()]:
            if file.relative_to(partial).as_posix() not in sums:
                file.unlink()
        yield


def fetch(remote: stores.RemoteFolder, path: str, folder: Path, most: int) -> int:
    """Download up to `most` bytes of the file `path` into `folder`; return how many."""
    target = folder / path
    with stores.explained(f"{remote.name}: {path}"), writing(target, place=False):
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("wb") as file:
            return sum(map(file.write, remote.blocks(path, most)))


def _present(target: Path, description: Mapping[str, Any], sums: Mapping[str, str]) -> Dataset:
    """Return the dataset in folder `target`, which must be the one described, whole."""
    changed = stores.altered(target, sums)
    try:
        dataset = Dataset.open(target)
        is_other = any(dataset.description.get(key) != description.get(key) for key in ("name", "content_hash"))
    except AstraDataError as error:
        if isinstance(error, CorruptDatasetError) and len(changed) < len(sums):
            raise CorruptDatasetError(f"{error} Delete it, or pull to another folder.") from error
        is_other = True
    if is_other:
        raise BadInputError(f"{target} exists already and holds something else; delete it or choose another folder.")
    if changed:
        where = f"it differs from what is shared in {', '.join(changed)}"
        raise CorruptDatasetError(f"{target} was altered: {where}. Delete it, or pull to another folder.")
    return dataset


def _check(folder: Path, sums: Mapping[str, str], description: Mapping[str, Any], name: str) -> None:
    """Check that the files, which anybody may have written, are the complete dataset."""
    if wrong := stores.altered(folder, sums):
        for path in wrong:
            (folder / path).unlink(missing_ok=True)
        raise SharingError(
            f"{name}: {', '.join(wrong)} do not have the sha256 in {stores.SUMS_PATH}: the download was "
            "cut off: run the same command again; if it says so again, they were altered there: push another version."
        )
    try:
        dataset = Dataset.open(folder)
        faults = check(folder).faults
        if dataset.content_hash != description.get("content_hash"):
            faults.append("its description changed during the download")
    except Exception as error:  # noqa: BLE001 - raised below
        faults = [str(error)]
    if faults:
        shutil.rmtree(folder)
        raise SharingError(f"{name} is not a complete dataset: {'; '.join(faults)}.")
