"""Whether predicted failures come true: observed against predicted rates, and how many steps there are."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from astra_data.core.arrays import Floats
from astra_data.core.naming import is_plus
from astra_data.reports.figures.scene import Scene
from astra_data.reports.figures.style import FAINT, method_color, method_title, style
from astra_data.reports.predicted_failures import failure_rates
from astra_data.reports.results import Results

_TICKS = (0.01, 0.1, 0.3, 0.6, 1.0)


def reliability_of(results: Results, _: Scene) -> Figure | None:
    """Draw the `reliability` of the groundings of results; None where none predicts failures."""
    rates = failure_rates(results)
    return reliability(rates) if rates else None


def reliability(parts: Mapping[str, Mapping[str, Floats]]) -> Figure:
    """Draw observed against predicted rates, equal on the dashed line, above the number of steps at each.

    Both rates are drawn by their square roots, as most are small.

    Args:
        parts: what predicts failures → row → predicted rates, observed rates and numbers of steps, (3, bins).
    """
    rows = list(dict.fromkeys(row for rates in parts.values() for row in rates))
    with style():
        figure = Figure(figsize=(1.9 + 2.7 * len(parts), 4.2), layout="constrained")
        above, below = figure.subplots(
            2, len(parts), squeeze=False, sharex=True, sharey="row", height_ratios=[2.6, 1.0]
        )
        for (title, rates), axes, counts in zip(parts.items(), above, below, strict=True):
            axes.plot([0, 1], [0, 1], color=FAINT, ls="--", lw=0.9, zorder=1)
            for row, (predicted, observed, steps) in rates.items():
                look = f"{'--' if is_plus(row) else '-'}o"
                color, label = method_color(row), method_title(row)
                axes.plot(predicted, observed, look, color=color, ms=4, label=label, clip_on=False)
                counts.plot(predicted, steps, look, color=color, ms=4)
            axes.set_title(title, loc="left")
            _by_square_root(axes)
            counts.set_yscale("log")
            counts.set_xlabel("predicted rate")
            for each in (axes, counts):
                each.grid(visible=True, axis="both")
        above[0].set_ylabel("observed rate")
        below[0].set_ylabel("steps")
        handles = {line.get_label(): line for axes in above for line in axes.lines[1:]}
        titles = [*map(method_title, rows)]
        figure.legend([handles[title] for title in titles], titles, loc="outside right center")
        return figure


def _by_square_root(axes: Axes) -> None:
    for axis, limits, ticks in (
        (axes.set_xscale, axes.set_xlim, axes.set_xticks),
        (axes.set_yscale, axes.set_ylim, axes.set_yticks),
    ):
        axis("function", functions=(_root, np.square))
        limits(0.0, 1.0)
        ticks(_TICKS, [f"{tick:g}" for tick in _TICKS])


def _root(values: Floats) -> Floats:
    roots: Floats = np.sqrt(np.maximum(values, 0.0))
    return roots
