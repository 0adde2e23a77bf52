"""How fast a simulator drifts from the target under the target's own actions."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from astra_data.core.arrays import Floats
from astra_data.core.naming import is_plus
from astra_data.reports.figures.scene import Scene
from astra_data.reports.figures.style import INK, method_color, method_title, style
from astra_data.reports.results import Results

SAME = 0.01
"""Ungrounded simulators whose errors differ by less than this share are drawn once."""


def open_loop_error(results: Results, _: Scene) -> Figure | None:
    """Draw the error over the horizon, one panel per quantity (named with its unit), on logarithmic axes."""
    if not results.errors:
        return None
    means = results.mean_errors()
    rows = [row for row in results.groundings() if (row, "grounded") in means.index]
    quantities = list(dict.fromkeys(means.index.get_level_values("quantity")))
    with style():
        figure = Figure(figsize=(1.7 + 2.9 * len(quantities), 3.3), layout="constrained")
        grid = figure.subplots(1, len(quantities), squeeze=False)[0]
        for axes, quantity in zip(grid, quantities, strict=True):
            drawn: list[Floats] = []
            for row in rows:
                raw = means.loc[(row, "raw", quantity)]
                values = raw.to_numpy().T
                if not any(np.allclose(values, seen, rtol=SAME, equal_nan=True) for seen in drawn):
                    drawn.append(values)
                    label = "no grounding" if len(drawn) == 1 else None
                    _line(axes, raw.index.to_numpy(), values, color=INK, dashes=":", label=label)
            for row in rows:
                band = means.loc[(row, "grounded", quantity)]
                look = {"color": method_color(row), "dashes": "--" if is_plus(row) else "-"}
                _line(axes, band.index.to_numpy(), band.to_numpy().T, label=method_title(row), **look)
            horizons = means.index.get_level_values("horizon").unique()
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
