"""What is said of a folder that cannot be opened as a dataset."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.core.naming import RECORD
from astra_data.core.wording import first_few
from astra_data.dataset.declared import declared_columns
from astra_data.dataset.format import CODEBASE_VERSION, INFO_PATH, OUR_FOLDER
from astra_data.dataset.plain import is_format_2, read_object

REPAIR = "astra-data repair {} --out DIR"
"""The command that writes what is intact in a folder to another one."""
_SHOWN = 4
"""Datasets of a run."""


def refuse_others(root: Path) -> None:
    """Raise BadInputError where `root` holds no dataset, versions of one, or one of another format."""
    refuse_versions(root)
    if fault := format_fault(root):
        raise BadInputError(fault)
    if not (root / "meta").is_dir():
        refuse_run(root)
        if logs := sorted(path.name for path in root.glob("*.[cC][sS][vV]")):
            raise BadInputError(
                f"{root} contains logs ({logs[0]} and so on): make them a dataset with `astra-data import` "
                "and a mapping, which `astra-data new` writes"
            )
        raise BadInputError(
            f"{root}: found no dataset; check the path (`astra-data list` shows where names are) "
            "or run the stage that writes it."
        )


def format_fault(root: Path) -> str | None:
    """Return a sentence if the dataset in `root` is LeRobot's and of another format than ours."""
    info = read_object(root / INFO_PATH)
    version = info.get("codebase_version") if isinstance(info, dict) else CODEBASE_VERSION
    if version == CODEBASE_VERSION or (root / OUR_FOLDER).is_dir():
        return None
    found = f"{root} has LeRobot's format {version}, expected {CODEBASE_VERSION}"
    if not is_format_2(root):
        return f"{found}: convert it with a version of lerobot that reads both"
    return f"{found}: convert it with lerobot's convert_dataset_v21_to_v30, or {REPAIR.format(root)}"


def refuse_versions(root: Path) -> None:
    """Raise BadInputError where `root` holds versions of a dataset; name them."""
    versions = sorted(path.name for path in root.glob("data-*.*.*") if (path / INFO_PATH).is_file())
    if versions:
        raise BadInputError(f"{root} contains versions of a dataset: name one of {', '.join(versions)}.")


def refuse_run(root: Path) -> None:
    """Raise BadInputError where `root` is the folder of a run; name the datasets in it."""
    if not (root / RECORD).is_file():
        return
    places = ("*/seed_*", "*/percent_*/seed_*")
    found = sorted(info.parents[1] for place in places for info in root.glob(f"{place}/{INFO_PATH}"))
    held = f"its datasets are {first_few(found, _SHOWN)}" if found else "it has no datasets yet"
    raise BadInputError(f"{root} is a run; {held}")


@contextmanager
def explained(root: Path) -> Iterator[None]:
    """Say of a CorruptDatasetError, or of missing metadata, which dataset it is and what can be done."""
    try:
        yield
    except (CorruptDatasetError, KeyError) as error:
        fault = f"{error} is missing in its metadata" if isinstance(error, KeyError) else error
        others = " or run the stage that wrote it again"
        if can_be_repaired(root):
            others = (
                ", run the stage that wrote it again, or recover its intact episodes: "
                f"`astra-data repair {root} --out FOLDER`"
            )
        raise CorruptDatasetError(
            f"{root} is incomplete or was altered: {fault}. Restore it from a copy{others}."
        ) from error


def can_be_repaired(root: Path) -> bool:
    """Return whether columns and rate of the dataset in `root` are known, without which no value is."""
    info = read_object(root / INFO_PATH)
    if isinstance(info, str):
        return False
    try:
        declared_columns(root, info)
    except CorruptDatasetError:
        return False
    return True
