"""The JSON files of the metadata, validated by strict models."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from astra_data.core.config import Config, Count, validated
from astra_data.core.errors import BadInputError, CorruptDatasetError, RecipeError
from astra_data.dataset.columns import Column
from astra_data.dataset.description import NAME, VERSION
from astra_data.dataset.format import DATASET_PATH, INFO_PATH, SUBSETS_PATH
from astra_data.dataset.plain import MOST_FPS, is_data_path, read_object
from astra_data.dataset.seal import is_description_sealed

NameText = Annotated[str, Field(pattern=f"^{NAME.pattern}$")]
VersionText = Annotated[str, Field(pattern=f"^{VERSION.pattern}$")]
"""Names and versions of datasets in files."""


def _data_path(pattern: str) -> str:
    if not is_data_path(pattern):
        raise ValueError(f"expected a path inside the dataset's folder, got {pattern!r}")
    return pattern


class _Open(Config):
    """Like `Config`, but accepts further keys, which other tools may add."""

    model_config = ConfigDict(extra="allow")


class _Meaning(Config):
    meaning: str = ""
    unit: tuple[str, ...] = ()
    frame: tuple[str, ...] = ()
    role: tuple[str, ...] = ()


class _Feature(_Open):
    dtype: Literal["float32", "int64", "bool"]
    shape: tuple[Count]
    names: tuple[str, ...] | None = None
    astra: _Meaning | None = None


class _Info(_Open):
    fps: int = Field(ge=1, lt=MOST_FPS)
    features: dict[str, _Feature]
    total_episodes: Count
    total_frames: Count
    data_path: Annotated[str, AfterValidator(_data_path)]


class _Identity(Config):
    name: NameText
    version: VersionText
    hash: str


class _Description(_Open):
    name: NameText
    version: VersionText
    parents: tuple[_Identity, ...]
    stage: str = Field(min_length=1)
    config: dict[str, Any]
    seeds: dict[str, Any]
    environment: dict[str, Any]
    simulator: dict[str, Any]
    packages: dict[str, str]
    git_commit: str | None
    content_hash: str
    sums: dict[str, str]


class _Subsets(_Open):
    seed: int
    uids: tuple[int, ...]


def read_info(root: Path) -> dict[str, Any]:
    """Return meta/info.json of the dataset in folder `root`; its features are valid columns.

    Raises:
        CorruptDatasetError: it is missing or malformed; lists every fault.
    """
    info = _read(root / INFO_PATH, INFO_PATH, _Info)
    faults = []
    for name, feature in info["features"].items():
        try:
            Column.from_feature(name, feature)
        except BadInputError as error:
            faults.append(str(error))
    if faults:
        raise CorruptDatasetError(f"{INFO_PATH}: {' '.join(faults)}")
    return info


def read_description(root: Path) -> dict[str, Any]:
    """Return meta/astra/dataset.json: the result of `complete_description`, the content hash, and more.

    Raises:
        CorruptDatasetError: it is missing, malformed or altered; lists every fault.
    """
    description = _read(root / DATASET_PATH, DATASET_PATH, _Description)
    if not is_description_sealed(description):
        raise CorruptDatasetError(f"{DATASET_PATH} was altered")
    return description


def read_subsets(root: Path) -> dict[str, Any]:
    """Return meta/astra/subsets.json: "seed" and "uids".

    Raises:
        CorruptDatasetError: it is missing or malformed; lists every fault.
    """
    return _read(root / SUBSETS_PATH, SUBSETS_PATH, _Subsets)


def _read(path: Path, name: str, model: type[BaseModel]) -> dict[str, Any]:
    found = read_object(path)
    if isinstance(found, str):
        raise CorruptDatasetError(f"{name} {found}")
    try:
        validated(found, model, name)
    except RecipeError as error:
        raise CorruptDatasetError(str(error).replace(":\n  ", ": ").replace("\n  ", "; ")) from error
    return found
