"""Find the artifacts of all rows and seeds of a recipe."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pydantic import JsonValue

from astra_data.core.errors import BadInputError, MissingStageError
from astra_data.core.naming import artifact_key
from astra_data.dataset.format import DATASET_PATH
from astra_data.methods import grounded_as
from astra_data.reports.artifacts import EVALUATION, Artifact, DatasetFile, Evaluation, read_json

SHARED_BY_ROWS = ("ground", "align")
"""Stages whose artifacts a "_plus" row takes from its base row."""


@dataclass(frozen=True, kw_only=True)
class Reported:
    """What stages of a whole recipe need of it, small enough to be sent to another process.

    Attributes:
        name: of the recipe's file, without its ending. task: as `task_named` takes it.
        methods: rows, in the order of the table. seeds: those to report, as far as they are finished.
        settings: all settings of the recipe.
        percents: dataset sizes in percent that every row is repeated on; empty if only on the whole.
    """

    name: str
    task: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    settings: Mapping[str, JsonValue]
    percents: tuple[int, ...] = ()


@dataclass(frozen=True)
class Runs:
    """The artifacts of one recipe: `root`/<stage>/<method>/seed_<seed>/.

    Attributes:
        reported: what is reported of the recipe.
        root: its folder of runs.
        percent: the dataset size, if there are several.
    """

    reported: Reported
    root: Path
    percent: int | None = None

    def __post_init__(self) -> None:
        """Check that there are rows and seeds."""
        if not self.reported.methods or not self.reported.seeds:
            raise BadInputError(
                f"{self.reported.name}: expected methods and seeds, got none; name some in the recipe"
            )

    def owner(self, stage: str, method: str) -> str:
        """Return the row in whose folder the artifact is: rows may share a grounding and its alignment."""
        if stage in SHARED_BY_ROWS and not (self.root / stage / method).is_dir():
            return grounded_as(method)
        return method

    def path(self, stage: str, method: str, seed: int, name: str) -> Path:
        """Return the path of a stage's file for one row and seed."""
        return self.root / artifact_key(stage, self.owner(stage, method), seed, self.percent) / name

    @cached_property
    def _seeds(self) -> dict[str, tuple[int, ...]]:
        return {
            method: tuple(
                seed
                for seed in self.reported.seeds
                if self.path("evaluate", method, seed, EVALUATION).exists()
            )
            for method in self.reported.methods
        }

    @property
    def any_finished(self) -> bool:
        """Whether any row has a finished evaluation."""
        return any(self._seeds.values())

    @property
    def finished(self) -> dict[str, tuple[int, ...]]:
        """The seeds of each row whose evaluation is finished, without rows that have none.

        Raises:
            MissingStageError: no row has one.
        """
        if not self.any_finished:
            self._require("evaluate", EVALUATION, dict.fromkeys(self.reported.methods, self.reported.seeds))
        return {method: found for method, found in self._seeds.items() if found}

    def evaluations(self) -> dict[str, dict[int, Evaluation]]:
        """Read the evaluation of every row and finished seed: row → seed → file."""
        return self._read("evaluate", EVALUATION, Evaluation, tuple(self.finished))

    def optional[T: Artifact](self, stage: str, name: str, model: type[T]) -> dict[str, dict[int, T]]:
        """Read a file for the rows that have it for all finished seeds (or none): owner → seed → file."""
        present = [
            method
            for method, seeds in self.finished.items()
            if any(self.path(stage, method, seed, name).exists() for seed in seeds)
        ]
        return self._read(stage, name, model, present)

    def datasets(self, stage: str) -> dict[int, DatasetFile]:
        """Read the metadata of the datasets that a stage wrote, by seed."""
        percent = self.percent if stage == "subset" else None
        paths = {
            seed: self.root / artifact_key(stage, "", seed, percent) / DATASET_PATH
            for seed in self.reported.seeds
        }
        return {seed: read_json(DatasetFile, path) for seed, path in paths.items() if path.exists()}

    def require(self, stage: str, name: str, methods: Sequence[str]) -> None:
        """Check that the rows have a file for every finished seed.

        Raises:
            MissingStageError: some do not; the message lists them.
        """
        self._require(stage, name, {method: self.finished[method] for method in methods})

    def _require(self, stage: str, name: str, wanted: Mapping[str, Sequence[int]]) -> None:
        missing = {
            method: [seed for seed in seeds if not self.path(stage, method, seed, name).exists()]
            for method, seeds in wanted.items()
        }
        missing = {method: seeds for method, seeds in missing.items() if seeds}
        if not missing:
            return
        absent = "; ".join(f"{row} seed {', '.join(map(str, seeds))}" for row, seeds in missing.items())
        size = "" if self.percent is None else f"percent_{self.percent:03d}/"
        raise MissingStageError(
            f"expected {name} in {self.root / stage}/<method>/{size}seed_<seed>/, found none for {absent}; "
            f"run the recipe {self.reported.name} again: it continues with what is missing"
        )

    def _read[T: Artifact](
        self, stage: str, name: str, model: type[T], methods: Sequence[str]
    ) -> dict[str, dict[int, T]]:
        self.require(stage, name, methods)
        paths: dict[str, dict[int, Path]] = {}
        for method in methods:
            # Rows that share an artifact may have different seeds of it.
            found = paths.setdefault(self.owner(stage, method), {})
            found |= {seed: self.path(stage, method, seed, name) for seed in self.finished[method]}
        return {
            owner: {seed: read_json(model, found[seed]) for seed in self.reported.seeds if seed in found}
            for owner, found in paths.items()
        }
