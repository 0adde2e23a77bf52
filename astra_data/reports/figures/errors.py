"""How wrong simulators are: open-loop errors, predicted failures, and returns beside those in the target."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

from astra_data.core.arrays import Floats
from astra_data.core.naming import is_plus
from astra_data.reports.figures.scene import Scene
from astra_data.reports.figures.style import FAINT, INK, method_color, method_title, style
from astra_data.reports.predicted_failures import failure_rates
from astra_data.reports.results import Results
from astra_data.reports.runs import SHARED_WORLDS

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


def predictive_validity(results: Results, _: Scene) -> Figure | None:
    """Draw the return in the target against that in each simulator; on the dashed line they are equal."""
    worlds = [world for world in SHARED_WORLDS if any(line.where == world for line in results.lines)]
    if results.tested_in != "target" or not worlds:
        return None
    rows = results.tested()
    with style():
        height = max(3.7, 0.6 + 0.19 * len(rows))
        figure = Figure(figsize=(2.4 + 3.0 * len(worlds), height), layout="constrained")
        grid = figure.subplots(1, len(worlds), squeeze=False, sharey=True)[0]
        for axes, world in zip(grid, worlds, strict=True):
            axes.axline((0, 0), slope=1, color=FAINT, ls="--", lw=0.9, zorder=1)
            for row in rows:
                target, there = results.values(row, "return"), results.values(row, "return", world)
                pairs = [(there[seed], target[seed]) for seed in there if seed in target]
                if pairs:
                    look = {"color": method_color(row), "mec": "white", "mew": 0.6, "ms": 6}
                    axes.plot(*zip(*pairs, strict=True), _marker(row), **look)
            axes.set_title(f"{world} simulator".capitalize(), loc="left")
            axes.set_xlabel("return in this simulator")
            axes.grid(visible=True, axis="both")
        grid[0].set_ylabel("return in the target")
        handles = [
            Line2D([], [], marker=_marker(row), ls="", color=method_color(row), mec="white", ms=6.5)
            for row in rows
        ]
        figure.legend(handles, [method_title(row) for row in rows], loc="outside right center")
        return figure


def _marker(row: str) -> str:
    return "^" if is_plus(row) else "o"
