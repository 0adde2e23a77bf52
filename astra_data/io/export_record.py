"""The record that an export carries: what its format has no place for, and a sum of every column.

With it, an export is compared with its dataset before it is shown, and imported again with the same values.
"""

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from astra_data.core.config import Config, Count, CountFromZero, faults_of
from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.columns import Array, Column, Episode
from astra_data.dataset.description import ContentHash, NameText, VersionText, full_name, identity_of
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import successor
from astra_data.dataset.writer import DatasetWriter
from astra_data.io.mapping import ColumnMapping, ImportMapping
from astra_data.io.recording import Block, Source

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


def read_record(module: ModuleType, source: Source) -> ExportRecord | None:
    """Return the record in `source`, None if it is no export of ours.

    Args:
        module: the importer of the format.
        source: the file.

    Raises:
        CorruptDatasetError: the record is malformed.
    """
    text = module.record(source) if hasattr(module, "record") else None
    return None if text is None else ExportRecord.parse(text, str(source))


def restored(module: ModuleType, source: Source, record: ExportRecord) -> Iterator[Episode]:
    """Yield the episodes of an export as its dataset had them; memory holds a block and an episode.

    Args:
        module: the importer of the format.
        source: the file.
        record: its record.

    Raises:
        BadInputError: fields are missing.
        CorruptDatasetError: values differ from those that were exported; raised after the last episode.
    """
    columns, sums = record.columns, ContentHash()
    rest = {column.name: _empty(column) for column in columns}
    number = 0
    for block in module.read(source, _mapping(record)):
        values = {column.name: _values(block, column, record) for column in columns}
        for name, column_values in values.items():
            sums.update(name, column_values)
        rest = {name: np.concatenate([rest[name], values[name]]) for name in values}
        first, rows = 0, len(rest[columns[0].name])
        while number < len(record.lengths) and (last := first + record.lengths[number]) <= rows:
            metadata = {key: facts[number] for key, facts in record.metadata.items()}
            known = {key: fact for key, fact in metadata.items() if fact is not None}
            cut = {name: array[first:last] for name, array in rest.items()}
            yield Episode(record.uids[number], cut, known)
            first, number = last, number + 1
        rest = {name: array[first:] for name, array in rest.items()}
    found = sums.column_sums()
    wrong = [column.name for column in columns if found.get(column.name) != record.sums[column.name]]
    if wrong or number < len(record.lengths):
        raise CorruptDatasetError(
            f"{source} was altered or is incomplete: {', '.join(wrong) or 'the number of rows'} differs from "
            f"what was exported of {full_name(record.identity)}; export it again, or restore a copy"
        )


def write_restored(
    record: ExportRecord,
    episodes: Iterable[Episode],
    options: Mapping[str, Any],
    recordings: Sequence[Mapping[str, str]],
    out: Path | None,
) -> tuple[Path, int]:
    """Write the dataset that was exported as the version after it; return its folder and number of steps.

    Args:
        record: the record of the export.
        episodes: those of `restored`.
        options: name, fps and task, where they are to differ.
        recordings: names and sums of the files.
        out: the dataset's folder, by default its place at home.

    Raises:
        CorruptDatasetError: values differ from those that were exported; nothing is written.
    """
    began = time.perf_counter()
    name = options.get("name", record.name)
    anew: dict[str, Any] = {} if name == record.name else {"version": "1.0.0"}  # whatever is at home
    description, root = successor(
        dict(record),
        "description",
        stage="import",
        config={"recordings": list(recordings)},
        name=name,
        out=out,
        **anew,
    )
    frames = 0
    with DatasetWriter(
        root,
        record.columns,
        fps=options.get("fps", record.fps),
        task=options.get("task", record.task),
        description=description,
        subset_seed=record.subset_seed,
    ) as writer:
        for episode in episodes:
            writer.add(episode)
            frames += len(episode)
        if options.get("fps", record.fps) == record.fps and writer.content_hash != record.content_hash:
            raise CorruptDatasetError(
                f"the record of {full_name(record.identity)} was altered: with its uids, lengths and "
                "names, the values are not those that were exported; export it again, or restore a copy"
            )
        writer.made = {"wall_seconds": time.perf_counter() - began}
    return root, frames


def _mapping(record: ExportRecord) -> ImportMapping:
    """Return a mapping that reads every field once."""
    fields = dict.fromkeys(slot.field for slot in record.places.values())
    return ImportMapping(
        name=record.name,
        task=record.task,
        fps=record.fps,
        columns={str(number): ColumnMapping(fields=(field,)) for number, field in enumerate(fields)},
        episodes=record.groups,
    )


def _empty(column: Column) -> Array:
    return np.empty((0, column.size) if column.size > 1 else 0, column.dtype)


def _values(block: Block, column: Column, record: ExportRecord) -> Array:
    slot = record.places[column.name]
    stored = np.asarray(block.values[slot.field])
    rows = stored.reshape(len(block), -1)[:, slot.first : slot.first + slot.size]
    if stored.dtype.kind not in "biuf" or rows.shape[1] != column.size:
        raise CorruptDatasetError(
            f"{block.origin}: field '{slot.field}' holds {stored.dtype} of shape {stored.shape}, expected "
            f"{column.size} numbers per row"
        )
    values = np.ascontiguousarray(rows, column.dtype)
    return values[:, 0].copy() if column.size == 1 else values
