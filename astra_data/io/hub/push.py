"""Share a version of a dataset."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from astra_data.core.config import load_recipe
from astra_data.core.errors import BadInputError, CorruptDatasetError, SharingError
from astra_data.core.progress import Progress, silent
from astra_data.dataset.doctor.check import check
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version, open_dataset
from astra_data.io.hub.address import Hub, Url, parse_place
from astra_data.io.hub.card import write_card
from astra_data.io.hub.hub import HubStore
from astra_data.io.hub.notes import Notes
from astra_data.io.hub.store import RemoteFolder, Store
from astra_data.io.hub.sums import SUMS_PATH, Listed, make_sums, parse_sums
from astra_data.io.hub.urls import UrlStore


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
            knows, below which <name>/data-<version>/ is made.
        notes: TOML file with the hand-written part of the card, see `Notes`.
        private: create the repository on the Hub as private, and refuse one that is public.
        progress: called with the fraction done.

    Returns:
        the source from which `pull` downloads it, with its version.

    Raises:
        BadInputError: there is no such dataset, the place holds something else under this version, the
            Hub rejects the card, or a repository that should be private is public.
        CorruptDatasetError: the dataset is incomplete or was altered.
        RecipeError: the notes have faults.
        SharingError: the place denies access or cannot be reached, or the version in it was altered.

    Example:
        >>> from astra_data import push
        >>> push("walks", "./shared").rpartition("/shared/")[2]
        'walks@data-1.0.0'
    """
    place = parse_place(destination)
    local = open_dataset(dataset)
    if local.recorded is not None:
        raise BadInputError(
            f"{local.root} was recorded by LeRobot: make a dataset of it first, with `astra-data subset "
            f"{local.root} --percent 100`"
        )
    written = load_recipe(notes, Notes) if notes else Notes()
    if private and isinstance(place, Url):
        raise BadInputError(
            f"{place}: private is for the Hugging Face Hub; elsewhere, set the permissions of the storage."
        )
    if faults := check(local.root).faults:
        raise CorruptDatasetError(f"{local.root} was altered: {'; '.join(faults)}. Restore it from a copy.")
    version = Version.parse(local.description["version"])
    if isinstance(place, Url):
        place = Url(f"{place}/{local.description['name']}")
    with TemporaryDirectory() as folder:
        card = Path(folder)
        write_card(local, card / "README.md", written, source=str(place))
        store: Store
        if isinstance(place, Hub):
            store = hub = HubStore(place.repo)
            hub.create(card, private=private)
        else:
            store = UrlStore(place.url)
        if version in store.versions():
            _refuse_change(store.folder(version), local)
        else:
            (card / SUMS_PATH).write_text(make_sums(local.root), encoding="utf-8")
            store.upload(local, card, progress)
    return f"{place}@{version.tag}"


def _refuse_change(there: RemoteFolder, local: Dataset) -> None:
    """Compare a version that was shared with ours: its description, its sums, and its files."""
    found = there.description().get("content_hash")
    if found != local.content_hash:
        raise BadInputError(
            f"{there.name} holds other values: its content hash is {found}, not {local.content_hash}. "
            "Versions never change: give the dataset a new one, or push elsewhere."
        )
    ours = parse_sums(make_sums(local.root), str(local.root))
    listed = parse_sums(there.read_text(SUMS_PATH), there.name)
    names = ours.keys() | listed.keys()
    others = sorted(path for path in names if _digest(ours, path) != _digest(listed, path))
    if others:
        raise BadInputError(
            f"{there.name} holds the same values, but {SUMS_PATH} there lists other files as "
            f"{', '.join(others)}: it was altered, or pushed from another copy. Look at it and delete it "
            "there, or push elsewhere."
        )
    if changed := there.altered(ours):
        raise SharingError(
            f"{there.name} was altered: {', '.join(changed)} there differ from {SUMS_PATH}. "
            "Delete this version there and push again, or push elsewhere."
        )


def _digest(sums: Mapping[str, Listed], path: str) -> str | None:
    return sums[path].digest if path in sums else None
