"""The points of a recipe: which of its rows, seeds and sizes are asked for."""

from collections.abc import Sequence
from dataclasses import dataclass

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.core.naming import place
from astra_data.experiments.recipe import Recipe


@dataclass(frozen=True)
class Point:
    """What is trained and measured as one: a row on the dataset of one seed, or on one size of it."""

    method: str
    seed: int
    percent: int | None = None

    @property
    def key(self) -> str:
        """Key of the evaluation, with which the point is finished."""
        return f"evaluate/{self.method}/{place(self.seed, self.percent)}"


@dataclass(frozen=True)
class Part:
    """The rows, seeds and sizes of a recipe that are asked for; `percents` is empty where it has no sizes."""

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
    ) -> "Part":
        """Return what is asked for; where nothing is named, all.

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

    def points(self) -> tuple[Point, ...]:
        """Return every row on every size of every seed."""
        return tuple(
            Point(method, seed, percent)
            for method in self.methods
            for percent in self.percents or (None,)
            for seed in self.seeds
        )
