"""Figures: a line of `FIGURES`, and a function from results and scene to a Figure, or to None with nothing to draw."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

from matplotlib.figure import Figure

from astra_data.reports.blocks import Picture
from astra_data.reports.figures import charts
from astra_data.reports.figures.motion import mismatch, trajectories
from astra_data.reports.figures.style import Scene, png
from astra_data.reports.results import Results


@dataclass(frozen=True)
class Drawing:
    """A figure of a section of the report; "{where}" in its words is where methods were tested."""

    draw: Callable[[Results, Scene], Figure | None]
    title: str
    caption: str
    section: Literal["methods", "gap", "failures", "validity", "sizes", "training"]


_BARS = "Bars: means over seeds, also as numbers beside the names. Dots: single seeds. Lines: 95 % intervals."
_DIAMONDS = (
    f"{_BARS} Diamonds: the same policies in the simulator of their training; the drop from diamond to bar is the "
    "cost of the transfer."
)

FIGURES = {
    "success": Drawing(partial(charts.score_bars, measure="success"), "Success {where}", _DIAMONDS, "methods"),
    "steps": Drawing(partial(charts.score_bars, measure="steps"), "Survived steps {where}", _DIAMONDS, "methods"),
    "return": Drawing(partial(charts.score_bars, measure="return"), "Return {where}", _BARS, "methods"),
    "trajectories": Drawing(
        trajectories,
        "Trajectories",
        "Orange, dashed: the policy in the simulator of its training. Blue: the same policy {where}. A "
        "failed episode ends with a cross, a successful one at its goal (a star if drawn). Starts and goals are "
        "drawn separately in the two worlds, so lines are not pairs: compare their routes and where they end. "
        "The number is the success rate {where} over all episodes and seeds.",
        "methods",
    ),
    "gap": Drawing(
        charts.open_loop_error,
        "Open-loop error by horizon",
        "The simulator starts in a state of the target and receives the target's actions; the error is its "
        "distance from the target. Lower is better. Dotted: no grounding. Bands: 95 % intervals over the "
        "episodes of each seed, averaged over seeds.",
        "gap",
    ),
    "mismatch": Drawing(
        mismatch,
        "The same commands in simulator and target",
        "The simulator without grounding (orange) and, repeatedly, the target (blue: mean; bands: 25 to 75 "
        "% and 5 to 95 %). Where they diverge, the simulator is missing something.",
        "gap",
    ),
    "reliability": Drawing(
        lambda results, _: charts.reliability(rates) if (rates := results.failure_rates()) else None,
        "Reliability of predicted failures",
        "On the dashed line, as many failures happen as are predicted; above it, more. Bottom: the number "
        "of steps with each prediction.",
        "failures",
    ),
    "validity": Drawing(
        charts.predictive_validity,
        "Return in the simulators and in the target",
        "Each dot is one policy (a seed of a method), with its mean return over the episodes. On the dashed "
        "line, the simulator predicts the target's return exactly. For choosing between policies, it is "
        "enough that what is better in the simulator is better in the target.",
        "validity",
    ),
    "data_efficiency": Drawing(
        charts.data_efficiency,
        "Data efficiency",
        "Top, if shown: positions and velocities in the datasets of one seed; brighter means more often. "
        "Bottom: means over seeds by size of the dataset; bands: their 95 % intervals; dots: single seeds.",
        "sizes",
    ),
    "learning": Drawing(
        charts.learning_curves,
        "Learning curves",
        "Headline score of training episodes, in the simulator the policy is trained in. Lines: means over "
        "seeds, dashed with the plus settings. Bands: from the worst seed to the best. Many episodes "
        "may start in the middle of a recording or be cut off early, so these are not results on the task; "
        "those are in the table. High here and low there means that the policy learned what does not work "
        "{where}.",
        "training",
    ),
}
PUBLISHED = ("success", "steps", "return", "trajectories", "gap", "data_efficiency")  # beside the tables


def drawn(results: Results, scene: Scene) -> dict[str, bytes]:
    """Return the figures of results as PNG, by name."""
    found = {name: figure.draw(results, scene) for name, figure in FIGURES.items()}
    return {name: png(figure) for name, figure in found.items() if figure is not None}


def pictures(results: Results, section: str) -> list[Picture]:
    """Return the figures of a section as blocks of a page."""
    where = results.where
    return [
        Picture(name, one.title.replace("{where}", where), one.caption.replace("{where}", where))
        for name, one in FIGURES.items()
        if one.section == section
    ]
