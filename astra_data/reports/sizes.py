"""Results at each dataset size, and their page."""

from collections.abc import Mapping
from typing import Literal

from astra_data.reports.choice_page import named
from astra_data.reports.cost_and_origin import provenance
from astra_data.reports.formatting import fill, interval, spread
from astra_data.reports.schema import Results, Section
from astra_data.reports.tested import warning, where

SHARED = ("collect", "pair", "select")
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
    """At least one; all have the same rows."""


def by_size(found: Results | SizesResults) -> dict[int | None, Results]:
    """Return the results of each dataset size, under None if the recipe does not sweep over sizes."""
    if isinstance(found, Results):
        return {None: found}
    return {size.percent: size.results for size in found.sizes}


def render_sizes(found: SizesResults, figures: Mapping[str, str]) -> str:
    """Return the page.

    Args:
        found: all numbers on it.
        figures: name → file name of each figure that was drawn; names as in `files.FIGURES`.
    """
    first = found.sizes[0].results
    seconds = sum(size.results.wall_seconds["total"] for size in found.sizes)
    # The artefacts of these stages are in the results of every size.
    seconds -= (len(found.sizes) - 1) * sum(first.wall_seconds.get(stage, 0.0) for stage in SHARED)
    means, intervals = size_lines(found)
    return fill(
        "sizes.md.jinja",
        found=found,
        first=first,
        figures=figures,
        warning=warning(first),
        where=where(first),
        wall_seconds=seconds,
        head=size_head(found),
        means=means,
        intervals=intervals,
        choices=[_choice(size) for size in found.sizes if size.results.choice],
        made=provenance([origin for size in found.sizes for origin in size.results.origins]),
    )


def size_head(found: SizesResults) -> list[str]:
    """Return the head of the tables whose lines `size_lines` returns."""
    return ["method", *(f"{size.percent} %" for size in found.sizes)]


def size_lines(found: SizesResults) -> tuple[list[list[str]], list[list[str]]]:
    """Return each row's headline score by size: mean and spread, and interquartile mean with its interval."""
    first = found.sizes[0].results
    score = first.headline
    means, intervals = [], []
    for method, row in first.methods.items():
        summaries = [size.results.methods[method].summary[score.measure] for size in found.sizes]
        means.append([row.title, *(spread(summary, score.digits) for summary in summaries)])
        intervals.append(
            [row.title, *(interval(one.iqm, one.low, one.high, score.digits) for one in summaries)]
        )
    return means, intervals


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
