"""Which rows, seeds and sizes of a recipe are to be made."""

from collections.abc import Sequence
from dataclasses import dataclass

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.core.naming import artifact_key
from astra_data.experiments.recipe import Recipe


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
        recipe: Recipe,
        methods: Sequence[str] = (),
        seeds: Sequence[int] = (),
        percents: Sequence[int] = (),
    ) -> "Selection":
        """Return those that are named; of an axis on which nothing is named, all.

        Raises:
            BadInputError: the recipe has no such method, seed or size.
        """
        for method in methods:
            if method not in recipe.methods:
                hint = did_you_mean(method, recipe.methods)
                raise BadInputError(f"the recipe has no method '{method}'{hint}")
        for what, asked, known in (("seed", seeds, recipe.seeds), ("size", percents, recipe.sweep.percent)):
            unknown = next((value for value in asked if value not in known), None)
            if unknown is not None:
                listed = ", ".join(map(str, known)) or "none"
                raise BadInputError(f"the recipe has no {what} {unknown}; its {what}s: {listed}")
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
