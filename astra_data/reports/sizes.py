"""Results at each dataset size, and their page."""

from collections.abc import Mapping
from itertools import chain
from typing import Literal

from pydantic import Field

from astra_data.reports.choice_page import named
from astra_data.reports.cost_and_origin import provenance
from astra_data.reports.costs import DATASET_STAGES
from astra_data.reports.formatting import fill, interval, spread
from astra_data.reports.schema import MethodResults, Results, Section
from astra_data.reports.tested import warning, where
from astra_data.worlds.score import Score

SHARED_BY_SIZES = (*(stage for stage in DATASET_STAGES if stage != "subset"), "select")
"""Stages that run once for all sizes."""


class SizeResults(Section):
    """The results at one dataset size."""

    percent: int
    """Of `collect.episodes`."""
    results: Results


class SizesResults(Section):
    """All numbers on the page of several dataset sizes and in its figure."""

    format: Literal[1] = 1
    recipe: str
    task: str
    command: str
    """The command that produced these results."""
    sizes: list[SizeResults]
    """At least one; each has the rows that are finished there."""
    unfinished: list[int] = Field(default_factory=list, exclude_if=lambda percents: not percents)
    """Sizes of the recipe without a finished row."""

    def methods(self) -> list[str]:
        """Return the rows that are finished at any size, in the order of the size that has most."""
        rows = sorted((list(size.results.methods) for size in self.sizes), key=len, reverse=True)
        return list(dict.fromkeys(chain.from_iterable(rows)))

    def seeds(self) -> list[int]:
        """Return the seeds that any row has finished at any size."""
        return sorted({seed for size in self.sizes for seed in size.results.seeds})


def by_size(found: Results | SizesResults) -> dict[int | None, Results]:
    """Return the results of each dataset size, under None if the recipe does not sweep over sizes."""
    if isinstance(found, Results):
        return {None: found}
    return {size.percent: size.results for size in found.sizes}


def points_of(found: Results | SizesResults) -> list[tuple[int | None, str, int]]:
    """Return the size of the dataset, the row and the seed of each result."""
    return [
        (percent, name, seed)
        for percent, results in by_size(found).items()
        for name, row in results.methods.items()
        for seed in row.seeds
    ]


def render_sizes(found: SizesResults, figures: Mapping[str, str]) -> str:
    """Return the page.

    Args:
        found: all numbers on it.
        figures: name → file name of each figure that was drawn; names as in `files.FIGURES`.
    """
    first = found.sizes[0].results
    seconds = sum(size.results.wall_seconds["total"] for size in found.sizes)
    # The artifacts of these stages are in the results of every size.
    seconds -= (len(found.sizes) - 1) * sum(first.wall_seconds.get(stage, 0.0) for stage in SHARED_BY_SIZES)
    means, intervals = size_lines(found)
    return fill(
        "sizes.md.jinja",
        found=found,
        first=first,
        seeds=found.seeds(),
        unfinished=unfinished(found),
        figures=figures,
        warning=warning(first),
        where=where(first),
        wall_seconds=seconds,
        head=size_head(found),
        means=means,
        intervals=intervals,
        choices=[_choice(size) for size in found.sizes if size.results.choice],
        made=provenance([origin for size in found.sizes for origin in size.results.origins], first.own_code),
    )


def unfinished(found: SizesResults) -> str:
    """Return which rows are not finished at which sizes, or nothing."""
    lacking = [
        f"{' and '.join(size.results.unfinished)} at {size.percent} %"
        for size in found.sizes
        if size.results.unfinished
    ]
    return "; ".join([*lacking, *(f"all rows at {percent} %" for percent in found.unfinished)])


def size_head(found: SizesResults) -> list[str]:
    """Return the head of the tables whose lines `size_lines` returns."""
    return ["method", *(f"{size.percent} %" for size in found.sizes)]


def size_lines(found: SizesResults) -> tuple[list[list[str]], list[list[str]]]:
    """Return each row's headline score by size: mean and spread, and interquartile mean with its interval.

    "-" where a row is not finished; a mean over fewer seeds than others says of how many.
    """
    score, seeds = found.sizes[0].results.headline, len(found.seeds())
    means, intervals = [], []
    for method in found.methods():
        rows = [size.results.methods.get(method) for size in found.sizes]
        title = next(row.title for row in rows if row)
        means.append([title, *(_mean(row, score, seeds) if row else "-" for row in rows)])
        summaries = [row.summary[score.measure] if row else None for row in rows]
        intervals.append(
            [title, *(interval(of.iqm, of.low, of.high, score.digits) if of else "-" for of in summaries)]
        )
    return means, intervals


def _mean(row: MethodResults, score: Score, seeds: int) -> str:
    few = "" if len(row.seeds) == seeds else f" ({len(row.seeds)} seed{'s' if len(row.seeds) > 1 else ''})"
    return f"{spread(row.summary[score.measure], score.digits)}{few}"


def _choice(size: SizeResults) -> list[str]:
    """Return the line of what was chosen at a size."""
    choice = size.results.choice
    assert choice is not None
    best = choice.candidates[0]
    known = [best.target, choice.regret, choice.random_regret]
    return [
        *(f"{size.percent} %", named(best.row, best.seed)),
        interval(best.predicted, best.low, best.high),
        *("-" if value is None else f"{value:.2f}" for value in known),
    ]
