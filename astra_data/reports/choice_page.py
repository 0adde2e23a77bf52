"""The choice without the target as Markdown: a section of the report, and the page of the stage `select`."""

from typing import Any

from astra_data.methods import method_title
from astra_data.reports.choice import Judged, choice_of
from astra_data.reports.formatting import fill, interval
from astra_data.reports.halving import posterior
from astra_data.reports.schema import Choice
from astra_data.reports.trials import TrialsFile

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
        "best": named(best.row, best.seed),
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


def select_page(recipe: str, judged: Judged, trials: TrialsFile | None = None) -> str:
    """Return the page of all candidates, size by size, and of trials in the target where there are any."""
    choices = {percent: choice_of(judged, percent, measured={}, replicates=0) for percent in judged.percents}
    return (
        fill(
            "select.md.jinja",
            recipe=recipe,
            sizes=[(percent, choice_values(choice, shown=None)) for percent, choice in choices.items()],
            trials=trials,
            tried=[] if trials is None else trial_lines(judged, trials),
            chosen_by_trials=named(*trials.chosen) if trials and trials.chosen else "",
        ).rstrip()
        + "\n"
    )


def trial_lines(judged: Judged, trials: TrialsFile) -> list[list[str]]:
    """Return a line for each candidate of each round, as far as it was tried."""
    priors = {(one.row, one.seed): one.lower for one in judged.ranked(trials.percent)}
    counts = dict.fromkeys(priors, (0, 0))
    lines = []
    for number, of in enumerate(trials.rounds, start=1):
        for one in of.tried:
            key = (one.row, one.seed)
            counts[key] = (counts[key][0] + sum(one.success), counts[key][1] + len(one.success))
            mean = posterior(priors[key], *counts[key])
            cells = (f"{number}", method_title(one.row), f"{one.seed}", f"{sum(one.success)}")
            lines.append([*cells, f"{len(one.success)}", f"{mean:.2f}"])
    return lines


def named(row: str, seed: int) -> str:
    """Return the name of a candidate on a page."""
    return f"{method_title(row)}, seed {seed}"
