"""The record that an export carries: what its format has no place for, and a sum of every column.

With it, an export is compared with its dataset before it is shown, and imported again with the same values.
"""

import json
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Self

from pydantic import Field, ValidationError, model_validator

from astra_data.core.config import Config, Count, CountFromZero, faults_of
from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.columns import Column, Episode
from astra_data.dataset.description import ContentHash, identity_of
from astra_data.dataset.meta_files import NameText, VersionText
from astra_data.dataset.reader import Dataset

Uid = Annotated[int, Field(ge=0, lt=2**63)]
Fact = bool | int | float | str | None


class Slot(Config):
    """Where a column lies: `size` values of `field` from `first` on."""

    field: str
    """Field of the format."""
    first: CountFromZero
    """The first of its values."""
    size: Count
    """How many of them."""


class ExportRecord(Config):
    """What an export says of its dataset."""

    name: NameText
    """The dataset's name."""
    version: VersionText
    """Its version."""
    content_hash: str
    """Its hash."""
    fps: Count
    """Steps per second."""
    task: str
    """The task of all episodes."""
    subset_seed: int
    """Seed of the nested subsets."""
    seeds: dict[str, Any]
    """As in its description."""
    environment: dict[str, Any]
    """As in its description."""
    simulator: dict[str, Any]
    """As in its description."""
    groups: str | None
    """As `episodes` in a mapping."""
    features: dict[str, dict[str, Any]]
    """LeRobot's features of the columns, with our units, frames and roles."""
    places: dict[str, Slot]
    """Where each column lies."""
    uids: tuple[Uid, ...]
    """Uid of each episode."""
    lengths: tuple[Count, ...]
    """Steps of each episode."""
    metadata: dict[str, tuple[Fact, ...]]
    """The episodes' metadata; None where an episode has none."""
    sums: dict[str, str]
    """The sha256 of each column's values."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.features or not self.features.keys() == self.places.keys() == self.sums.keys():
            raise ValueError("features, places and sums, expected the same columns in all of them")
        counts = {len(self.uids), len(self.lengths), *map(len, self.metadata.values())}
        if len(counts) > 1:
            raise ValueError("uids, lengths and metadata, expected as many entries in each")
        return self

    @property
    def columns(self) -> list[Column]:
        """The columns.

        Raises:
            BadInputError: one contradicts itself.
        """
        return [Column.from_feature(name, feature) for name, feature in self.features.items()]

    @property
    def identity(self) -> dict[str, str]:
        """Name, version and hash, as among the parents of the dataset that is made of the export."""
        return identity_of(dict(self))

    @classmethod
    def parse(cls, text: str | bytes, origin: str) -> "ExportRecord":
        """Read the record in the file `origin`.

        Raises:
            CorruptDatasetError: it is malformed.
        """
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            raise CorruptDatasetError(
                f"{origin}: its record of the export is malformed ({faults_of(error)}); "
                "export it again, or restore a copy"
            ) from None


class Export:
    """A dataset on its way into another format.

    Attributes:
        dataset: it.
        places: where each of its columns lies.
    """

    def __init__(
        self,
        dataset: Dataset,
        fields: Mapping[str, str],
        *,
        groups: str | None = None,
        first: Mapping[str, int] | None = None,
    ) -> None:
        """Prepare to export `dataset`.

        Args:
            dataset: any.
            fields: the field of each column.
            groups: what is an episode in HDF5, as `episodes` in a mapping.
            first: which value of its field is the first of a column, by default 0.
        """
        self.dataset = dataset
        self.places = {
            column.name: Slot(
                field=fields[column.name], first=(first or {}).get(column.name, 0), size=column.size
            )
            for column in dataset.schema
        }
        self._groups = groups
        self._sums = ContentHash()

    def episodes(self) -> Iterator[Episode]:
        """Yield all episodes with all columns."""
        for episode in self.dataset.episodes(list(self.places)):
            for name, values in episode.columns.items():
                self._sums.update(name, values)
            yield episode

    def record(self) -> dict[str, Any]:
        """Return the record as plain JSON, once all episodes were yielded."""
        dataset = self.dataset
        described = ("name", "version", "seeds", "environment", "simulator")
        return {
            **{key: dataset.description[key] for key in described},
            "content_hash": dataset.content_hash,
            "fps": dataset.info["fps"],
            "task": dataset.task,
            "subset_seed": dataset.subset_seed,
            "groups": self._groups,
            "features": {name: dataset.features[name] for name in self.places},
            "places": {name: slot.model_dump() for name, slot in self.places.items()},
            "uids": dataset.uids.tolist(),
            "lengths": dataset.lengths.tolist(),
            "metadata": dataset.metadata,
            "sums": self._sums.column_sums(),
        }

    def text(self) -> str:
        """Return the record as a string of JSON."""
        return json.dumps(self.record(), ensure_ascii=False)
