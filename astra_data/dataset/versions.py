"""Versions of datasets, and how they are named: `name@data-1.2.0`, or a folder.

Datasets without a folder of their own live at home, which is $ASTRA_DATA_HOME, by default ./datasets:

<home>/<name>/data-<version>/

A version never changes. Of MAJOR.MINOR.PATCH, a change of the columns increments the first number, one of the
episodes the second, one of the description alone the third.
"""

import logging
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.core.naming import shortened
from astra_data.dataset.columns import Column
from astra_data.dataset.description import NAME, VERSION, identity_of
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.plain import read_object
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter

_LOG = logging.getLogger(__name__)

Change = Literal["columns", "episodes"]

_REFERENCE = re.compile(rf"(?P<name>{NAME.pattern})(@(data-)?(?P<version>{VERSION.pattern}))?")


@dataclass(frozen=True, order=True)
class Version:
    """MAJOR.MINOR.PATCH; newer versions are greater."""

    major: int
    minor: int
    patch: int

    @classmethod
    def parse(cls, text: str) -> "Version":
        """Read "1.2.0"."""
        if not VERSION.fullmatch(text):
            raise BadInputError(f"version '{shortened(text, 80)}': expected three numbers such as 1.2.0")
        return cls(*map(int, text.split(".")))

    @property
    def tag(self) -> str:
        """The name of folders and git tags: "data-1.2.0"."""
        return f"data-{self}"

    @classmethod
    def from_tag(cls, tag: str) -> "Version | None":
        """Read "data-1.2.0"; None if it is no such tag."""
        return cls.parse(tag[5:]) if re.fullmatch(f"data-{VERSION.pattern}", tag) else None

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}.{self.patch}"

    def next(self, change: Change, taken: Iterable["Version"] = ()) -> "Version":
        """Return the version after `change`, greater than all of `taken` that it could collide with."""
        every = [self, *taken]
        if change == "columns":
            return Version(max(every).major + 1, 0, 0)
        return Version(self.major, max(one.minor for one in every if one.major == self.major) + 1, 0)


def home() -> Path:
    """Return the folder of datasets that have none of their own."""
    folder = Path(os.environ.get("ASTRA_DATA_HOME", "datasets"))
    if folder.exists() and not folder.is_dir():
        raise BadInputError(f"{folder} is no folder: expected that of the datasets; set $ASTRA_DATA_HOME to one")
    return folder


def home_of(description: Mapping[str, Any]) -> Path:
    """Return the folder at home of the dataset with this "name" and "version"."""
    return home() / str(description["name"]) / f"data-{description['version']}"


def names_at_home() -> list[str]:
    """Return the names of the datasets at home."""
    return sorted(folder.name for folder in home().glob("*") if versions_at_home(folder.name))


def versions_at_home(name: str) -> list[Version]:
    """Return the versions of dataset `name` at home, the oldest first."""
    folders = (folder for folder in (home() / name).glob("data-*") if folder.is_dir())
    return sorted(version for folder in folders if (version := Version.from_tag(folder.name)))


def locate(dataset: str | Path) -> Path:
    """Return the folder of `dataset`: one, `name@data-1.2.0`, or `name` for its highest version at home."""
    reference, folder = _REFERENCE.fullmatch(str(dataset)), Path(dataset)
    with suppress(OSError):  # its name may be too long for a file
        # A folder without a dataset or versions of one, such as that of `new`, does not hide a name.
        holds = (folder / "meta").is_dir() or any(folder.glob("data-*.*.*"))
        if folder.is_dir() and (holds or not reference or not versions_at_home(reference["name"])):
            return folder
    if not reference:
        raise BadInputError(f"{str(dataset)[:300]}: no such folder; expected a folder, name or name@data-1.2.0")
    name, version = reference["name"], reference["version"]
    versions = versions_at_home(name)
    if not versions:
        raise BadInputError(f"no dataset '{name}' in {home()}{did_you_mean(name, names_at_home())}")
    if version and Version.parse(version) not in versions:
        known = ", ".join(f"data-{known}" for known in versions)
        raise BadInputError(f"{name} has no version data-{version} in {home()}; it has {known}")
    folder = home_of({"name": name, "version": version or versions[-1]})
    made = read_object(folder / DATASET_PATH) if version is None and len(versions) > 1 else {}
    if isinstance(made, dict) and made.get("stage") == "subset":
        known = ", ".join(f"{name}@{known.tag}" for known in versions[:-1])
        _LOG.warning("%s is %s@%s here, a subset; the others are %s", name, name, versions[-1].tag, known)
    return folder


def open_dataset(dataset: str | Path) -> Dataset:
    """Open `dataset`, named as `locate` takes it; it raises as `Dataset.open` does."""
    return Dataset.open(locate(dataset))


def successor(
    source: Mapping[str, Any],
    change: Change,
    *,
    stage: str,
    config: Mapping[str, Any],
    name: str | None = None,
    out: Path | None = None,
    parents: Iterable[Mapping[str, str]] = (),
    **more: Any,
) -> tuple[dict[str, Any], Path]:
    """Return the description of the version that follows the description `source` by a `change`, and its folder.

    Name, seeds, environment and simulator are carried over, but for those in `more`; with another `name`, a new dataset
    begins with version 1.0.0. With `out`, the version does not depend on those at home.
    """
    kept = {key: source[key] for key in ("seeds", "environment", "simulator")}
    name = source["name"] if name is None else name
    taken = versions_at_home(name) if out is None else []
    before = Version.parse(source["version"]) if name == source["name"] else max(taken, default=None)
    version = before.next(change, taken) if before else Version(1, 0, 0)
    identities = [identity_of(source), *parents]
    made = {"name": name, "version": str(version), "stage": stage, "config": dict(config), "parents": identities}
    description = {**made, **kept, **more}
    return description, home_of(description) if out is None else out


def next_version(
    source: Dataset,
    change: Change,
    *,
    more: Sequence[Column] = (),
    cameras: bool = True,
    schema: Sequence[Column] | None = None,
    fps: int | None = None,
    subset_seed: int | None = None,
    task: str | None = None,
    **described: Any,
) -> DatasetWriter:
    """Prepare to write the version that follows `source`; its folder is the writer's `root`.

    Columns (or those of `schema`), of which there may be `more`, `cameras` unless False, `fps`, task, the seed of the
    subsets and the description are carried over; `described` is what `successor` takes: `stage`, `config`, `name`, ...
    """
    description, folder = successor(source.description, change, **described)
    return DatasetWriter(
        folder,
        [*(source.schema if schema is None else schema), *more],
        fps=fps or source.info["fps"],
        task=source.task if task is None else task,
        description=description,
        subset_seed=source.subset_seed if subset_seed is None else subset_seed,
        cameras={name: camera.feature for name, camera in source.cameras.items()} if cameras else {},
    )
