"""Results of each size of the dataset, and their page."""

from collections.abc import Mapping
from typing import Literal

from astra_data.reports.cost_and_origin import provenance
from astra_data.reports.formatting import duration, interval, spread, table
from astra_data.reports.schema import Part, Results

HOW_TO_READ = {
    "data_efficiency": (
        "Above: where the robot was and how fast it went, in the datasets of one seed; the "
        "brighter, the more often. Below: {score} in the target over the size; lines are interquartile means "
        "over seeds, bands their 95 % bootstrap intervals, dots single seeds."
    ),
}
"""The text under each figure, of a score."""

SHARED = ("collect", "pair")
"""Stages that work once for all sizes."""


class SizeResults(Part):
    """What the rows gave on one size of the dataset."""

    percent: int
    """Of `collect.episodes`."""
    results: Results


class SizesResults(Part):
    """All that the page and the figure of several sizes show."""

    format: Literal[1] = 1
    recipe: str
    task: str
    command: str
    """The command that produced these results."""
    sizes: list[SizeResults]
    """At least one; rows and seeds are those of each other."""


def by_size(found: Results | SizesResults) -> dict[int | None, Results]:
    """Return the results of each size of the dataset; of None where it is not swept over."""
    if isinstance(found, Results):
        return {None: found}
    return {size.percent: size.results for size in found.sizes}


def render_sizes(found: SizesResults, figures: Mapping[str, str]) -> str:
    """Return the page.

    Args:
        found: all numbers on it.
        figures: name → file name of each figure that was drawn; names as in `HOW_TO_READ`.
    """
    parts = [_head(found), _table(found)]
    score = found.sizes[0].results.headline.title
    parts += [
        f"## {name.replace('_', ' ').capitalize()}\n\n![{name}]({figures[name]})\n\n"
        + text.format(score=score)
        for name, text in HOW_TO_READ.items()
        if name in figures
    ]
    return "\n\n".join([*parts, _origin(found)]) + "\n"


def _head(found: SizesResults) -> str:
    first = found.sizes[0].results
    seeds = ", ".join(map(str, first.seeds))
    seconds = sum(size.results.wall_seconds["total"] for size in found.sizes)
    # The same artefacts are in the results of every size.
    seconds -= (len(found.sizes) - 1) * sum(first.wall_seconds.get(stage, 0.0) for stage in SHARED)
    return (
        f"# {found.recipe}\n\n"
        f"Task `{found.task}`, seeds {seeds}, {first.episodes} episodes per row, size and seed. "
        "Produced by\n\n"
        f"```\n{found.command}\n```\n\nWall time of the stages, summed: {duration(seconds)}."
    )


def _table(found: SizesResults) -> str:
    score = found.sizes[0].results.headline
    head = ["method", *(f"{size.percent} %" for size in found.sizes)]
    means, intervals = [], []
    for method, row in found.sizes[0].results.methods.items():
        summaries = [size.results.methods[method].summary[score.measure] for size in found.sizes]
        means.append([row.title, *(spread(summary, score.digits) for summary in summaries)])
        intervals.append(
            [row.title, *(interval(one.iqm, one.low, one.high, score.digits) for one in summaries)]
        )
    return "\n\n".join(
        [
            f"## {score.title.capitalize()} by size of the dataset",
            table(head, means),
            "Mean ± standard deviation over seeds, in the target.",
            table(head, intervals),
            "Interquartile mean over seeds with its 95 % stratified bootstrap interval.",
        ]
    )


def _origin(found: SizesResults) -> str:
    origins = [origin for size in found.sizes for origin in size.results.origins]
    return (
        f"## Where this comes from\n\n{provenance(origins)}\n"
        "- Datasets: named for each size and seed in the JSON file of these results."
    )
