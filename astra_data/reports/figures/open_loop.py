"""How fast a simulator drifts from the target under the target's own actions."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from astra_data.core.arrays import Floats
from astra_data.core.naming import is_plus
from astra_data.reports.figures.style import INK, method_color, method_title, style

SAME = 0.01
"""Ungrounded simulators whose errors differ by less than this share are drawn once."""


@dataclass(frozen=True)
class OpenLoop:
    """One row's open-loop error.

    Attributes:
        horizons: steps ahead, (K,).
        grounded: mean, low, high for each quantity after grounding, (3, K).
        raw: mean, low, high for each quantity before grounding, (3, K).
    """

    horizons: Floats
    grounded: Mapping[str, Floats]
    raw: Mapping[str, Floats]


def open_loop_error(gaps: Mapping[str, OpenLoop]) -> Figure:
    """Draw the error over the horizon, one panel per quantity, on logarithmic axes.

    Args:
        gaps: one per grounding, all with the same quantities, named with their unit ("position_m").
    """
    quantities = list(next(iter(gaps.values())).grounded)
    with style():
        figure = Figure(figsize=(1.7 + 2.9 * len(quantities), 3.3), layout="constrained")
        grid = figure.subplots(1, len(quantities), squeeze=False)[0]
        for axes, quantity in zip(grid, quantities, strict=True):
            drawn: list[Floats] = []
            for gap in gaps.values():
                raw = gap.raw[quantity]
                if not any(raw.shape == seen.shape and np.allclose(raw, seen, rtol=SAME) for seen in drawn):
                    drawn.append(raw)
                    label = "no grounding" if len(drawn) == 1 else None
                    _line(axes, gap.horizons, raw, color=INK, dashes=":", label=label)
            for method, gap in gaps.items():
                dashes = "--" if is_plus(method) else "-"
                color, label = method_color(method), method_title(method)
                _line(axes, gap.horizons, gap.grounded[quantity], color=color, dashes=dashes, label=label)
            horizons = np.unique(np.concatenate([gap.horizons for gap in gaps.values()]))
            axes.set(xscale="log", yscale="log", xlabel="horizon (steps)", ylabel=_label(quantity))
            axes.set_xticks(horizons, [f"{horizon:g}" for horizon in horizons])
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
            axes.yaxis.set_major_formatter("{x:g}")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_minor_locator(NullLocator())
        handles, labels = grid[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right center", handlelength=2.4)
        return figure


def _line(axes: Axes, horizons: Floats, band: Floats, *, color: str, dashes: str, label: str | None) -> None:
    mean, low, high = band
    axes.fill_between(horizons, low, high, color=color, alpha=0.13, lw=0)
    axes.plot(horizons, mean, dashes, color=color, marker="o", ms=3.5, label=label)


def _label(quantity: str) -> str:
    units = {"_m_s2": "m/s²", "_rad_s": "rad/s", "_m_s": "m/s", "_rad": "rad", "_deg": "°", "_m": "m"}
    for ending, unit in units.items():
        if quantity.endswith(ending):
            return f"{quantity.removesuffix(ending).replace('_', ' ')} error ({unit})"
    return f"{quantity.replace('_', ' ')} error"
