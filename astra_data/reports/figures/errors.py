"""How wrong simulators are: open-loop errors, predicted failures, and returns beside those in the target."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from astra_data.core.arrays import Floats
from astra_data.core.naming import is_plus
from astra_data.methods import method_title
from astra_data.reports.figures.style import FAINT, INK, Scene, draw_band, look, method_color, style
from astra_data.reports.results import Results
from astra_data.reports.runs import SHARED_WORLDS

SAME = 0.01  # ungrounded simulators whose errors differ by less than this share are drawn once
_UNITS = {"_m_s2": "m/s²", "_rad_s": "rad/s", "_m_s": "m/s", "_rad": "rad", "_deg": "°", "_m": "m"}
"""Endings of the names of quantities."""


@style()
def open_loop_error(results: Results, _: Scene) -> Figure | None:
    """Draw the error over the horizon, one panel per quantity (named with its unit), on logarithmic axes."""
    if not results.errors:
        return None
    means = results.mean_errors()
    rows = [row for row in results.groundings() if (row, "grounded") in means.index]
    quantities = list(dict.fromkeys(means.index.get_level_values("quantity")))
    horizons = means.index.get_level_values("horizon").unique()
    figure = Figure(figsize=(1.7 + 2.9 * len(quantities), 3.3), layout="constrained")
    grid = figure.subplots(1, len(quantities), squeeze=False)[0]
    for axes, quantity in zip(grid, quantities, strict=True):
        bands = {row: means.loc[(row, "grounded", quantity)] for row in rows}
        drawn: list[Floats] = []
        for row in rows:
            raw = means.loc[(row, "raw", quantity)]
            values = raw.to_numpy().T
            if not any(np.allclose(values, seen, rtol=SAME, equal_nan=True) for seen in drawn):
                label = None if drawn else "no grounding"
                draw_band(axes, raw.index, *values, color=INK, ls=":", label=label, marker="o", ms=3.5)
                drawn.append(values)
        for row, band in bands.items():
            draw_band(axes, band.index, *band.to_numpy().T, **look(row), marker="o", ms=3.5)
        ending = next((ending for ending in _UNITS if quantity.endswith(ending)), "")
        name = f"{quantity.removesuffix(ending).replace('_', ' ')} error"
        label = f"{name} ({_UNITS[ending]})" if ending else name
        axes.set(xscale="log", yscale="log", xlabel="horizon (steps)", ylabel=label)
        axes.set_xticks(horizons, [f"{horizon:g}" for horizon in horizons])
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", handlelength=2.4)
    return figure


_TICKS = (0.01, 0.1, 0.3, 0.6, 1.0)


@style()
def reliability(parts: Mapping[str, Mapping[str, Floats]]) -> Figure:
    """Draw observed against predicted rates of `parts`, by their square roots, above the number of steps at each."""

    def root(values: Floats) -> Floats:
        return np.asarray(np.sqrt(np.maximum(values, 0.0)))

    figure = Figure(figsize=(1.9 + 2.7 * len(parts), 4.2), layout="constrained")
    above, below = figure.subplots(2, len(parts), squeeze=False, sharex=True, sharey="row", height_ratios=[2.6, 1.0])
    handles: dict[str, Line2D] = {}
    for (title, rates), axes, counts in zip(parts.items(), above, below, strict=True):
        axes.plot([0, 1], [0, 1], color=FAINT, ls="--", lw=0.9, zorder=1)
        for row, (predicted, observed, steps) in rates.items():
            drawn = axes.plot(predicted, observed, marker="o", ms=4, clip_on=False, **look(row))
            handles.setdefault(method_title(row), drawn[0])
            counts.plot(predicted, steps, marker="o", ms=4, **look(row))
        axes.set_title(title, loc="left")
        for scale, set_ticks in ((axes.set_xscale, axes.set_xticks), (axes.set_yscale, axes.set_yticks)):
            scale("function", functions=(root, np.square))
            set_ticks(_TICKS, [f"{tick:g}" for tick in _TICKS])
        axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
        counts.set(yscale="log", xlabel="predicted rate")
        for each in (axes, counts):
            each.grid(visible=True, axis="both")
    above[0].set_ylabel("observed rate")
    below[0].set_ylabel("steps")
    figure.legend([*handles.values()], [*handles], loc="outside right center")
    return figure


@style()
def predictive_validity(results: Results, _: Scene) -> Figure | None:
    """Draw the return in the target against that in each simulator; on the dashed line they are equal."""
    worlds = [world for world in SHARED_WORLDS if any(line.where == world for line in results.lines)]
    if results.tested_in != "target" or not worlds:
        return None
    rows = results.tested()
    figure = Figure(figsize=(2.4 + 3.0 * len(worlds), max(3.7, 0.6 + 0.19 * len(rows))), layout="constrained")
    grid = figure.subplots(1, len(worlds), squeeze=False, sharey=True)[0]
    handles: dict[str, Line2D] = {}
    for axes, world in zip(grid, worlds, strict=True):
        axes.axline((0, 0), slope=1, color=FAINT, ls="--", lw=0.9, zorder=1)
        for row in rows:
            target, there = results.values(row, "return"), results.values(row, "return", world)
            if shared := [seed for seed in there if seed in target]:
                sides = ([of[seed] for seed in shared] for of in (there, target))
                drawing = {"color": method_color(row), "mec": "white", "mew": 0.6, "ms": 6}
                drawn = axes.plot(*sides, "^" if is_plus(row) else "o", **drawing)
                handles[method_title(row)] = drawn[0]
        axes.set_title(f"{world} simulator".capitalize(), loc="left")
        axes.set_xlabel("return in this simulator")
        axes.grid(visible=True, axis="both")
    grid[0].set_ylabel("return in the target")
    figure.legend([*handles.values()], [*handles], loc="outside right center")
    return figure
