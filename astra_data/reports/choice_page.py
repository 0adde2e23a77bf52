"""The choice without the target as Markdown: a section of the report, and the page of the stage `select`."""

from typing import Any

from astra_data.methods import method_title
from astra_data.reports.choice import Judged, choice_of
from astra_data.reports.formatting import fill, interval
from astra_data.reports.schema import Choice

SHOWN = 8
"""Candidates in the table of a report."""


def choice_values(choice: Choice | None, shown: int | None = SHOWN) -> dict[str, Any] | None:
    """Return what the macro `chosen` of the templates takes; None without a choice."""
    if choice is None:
        return None
    best, found = choice.candidates[0], choice.rank_correlation
    return {
        "choice": choice,
        "judge": method_title(choice.judge),
        "best": f"{method_title(best.row)}, seed {best.seed}",
        "candidates": [
            [
                *(method_title(one.row), f"{one.seed}", f"{one.lower:.2f}"),
                *(interval(one.predicted, one.low, one.high), f"{one.judges}"),
                "-" if one.target is None else f"{one.target:.2f}",
            ]
            for one in choice.candidates[:shown]
        ],
        "calibration": [
            [method_title(row), f"{one.seeds}", f"{one.signed:+.2f}", f"{one.absolute:.2f}"]
            for row, one in choice.calibration.items()
        ],
        "correlation": interval(found.value, found.low, found.high) if found else "",
    }


def select_page(recipe: str, judged: Judged) -> str:
    """Return the page of all candidates, size by size."""
    choices = {percent: choice_of(judged, percent, measured={}, replicates=0) for percent in judged.percents}
    sizes = [(percent, choice_values(choice, shown=None)) for percent, choice in choices.items()]
    return fill("select.md.jinja", recipe=recipe, sizes=sizes).rstrip() + "\n"
