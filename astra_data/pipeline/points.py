"""Which rows, seeds and sizes of a recipe are to be made."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.core.naming import artifact_key

if TYPE_CHECKING:  # its import takes seconds, which a wrong name need not wait for
    from astra_data.pipeline.recipe import Recipe


def refuse_unknown(
    methods: Collection[str],
    seeds: Collection[int],
    percents: Collection[int],
    known_methods: Collection[str],
    known_seeds: Collection[int],
    known_percents: Collection[int],
) -> None:
    """Refuse rows, seeds and sizes that are not among those of a recipe.

    Raises:
        BadInputError: the recipe has no such method, seed or size.
    """
    for method in methods:
        if method not in known_methods:
            raise BadInputError(f"the recipe has no method '{method}'{did_you_mean(method, known_methods)}")
    for what, asked, known in (("seed", seeds, known_seeds), ("size", percents, known_percents)):
        unknown = next((value for value in asked if value not in known), None)
        if unknown is not None:
            listed = ", ".join(map(str, known)) or "none"
            raise BadInputError(f"the recipe has no {what} {unknown}; its {what}s: {listed}")


def refuse_unmade(settings: Mapping[str, Any], row: str, seed: int) -> None:
    """Refuse a row or a seed that a run's recipe, which had these `settings`, does not have.

    Raises:
        BadInputError: it has no such row or seed.
    """
    rows, seeds = settings.get("methods", [row]), settings.get("seeds", [seed])
    if row not in rows:
        raise BadInputError(f"the run has no row '{row}'{did_you_mean(row, rows)}")
    if seed not in seeds:
        raise BadInputError(f"the run has no seed {seed}; its seeds: {', '.join(map(str, seeds))}")


@dataclass(frozen=True)
class RunPoint:
    """A row on the dataset of one seed, or on one size of it: the unit of training and evaluation."""

    method: str
    seed: int
    percent: int | None = None

    @property
    def key(self) -> str:
        """Key of its evaluation, the last artifact to be made for it."""
        return artifact_key("evaluate", self.method, self.seed, self.percent)


@dataclass(frozen=True)
class Selection:
    """Rows, seeds and sizes of a recipe; `percents` is empty where the recipe has no sizes."""

    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    percents: tuple[int, ...]

    @classmethod
    def of(
        cls,
        recipe: "Recipe",
        methods: Sequence[str] = (),
        seeds: Sequence[int] = (),
        percents: Sequence[int] = (),
    ) -> "Selection":
        """Return those that are named; of an axis on which nothing is named, all.

        Raises:
            BadInputError: the recipe has no such method, seed or size.
        """
        known = (recipe.methods, recipe.seeds, recipe.sweep.percent)
        refuse_unknown(methods, seeds, percents, *known)
        return cls(
            tuple(dict.fromkeys(methods)) or recipe.methods,
            tuple(dict.fromkeys(seeds)) or recipe.seeds,
            tuple(dict.fromkeys(percents)) or recipe.sweep.percent,
        )

    def points(self) -> tuple[RunPoint, ...]:
        """Return every row on every size of every seed."""
        return tuple(
            RunPoint(method, seed, percent)
            for method in self.methods
            for percent in self.percents or (None,)
            for seed in self.seeds
        )
