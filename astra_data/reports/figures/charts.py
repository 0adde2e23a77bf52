"""Charts: scores of each method, final, during training and by size of the dataset; how wrong simulators are."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator

from astra_data.core.arrays import Floats
from astra_data.core.naming import artifact_key, base_method, is_plus
from astra_data.dataset.inspection import Map, visited
from astra_data.dataset.reader import Dataset
from astra_data.methods import method_title
from astra_data.reports.figures import style
from astra_data.reports.results import SIMULATED, TESTED, Results, titled
from astra_data.reports.runs import SHARED_WORLDS

CURVE_POINTS = 200  # points at which curves of different seeds are interpolated
PANELS_ACROSS = 4  # learning-curve panels side by side, at most
_DOT: dict[str, Any] = {"mfc": "white", "mec": style.INK, "clip_on": False}  # the axis would cut what lies on 0
SAME = 0.01  # ungrounded simulators whose errors differ by less than this share are drawn once
_UNITS = {"_m_s2": "m/s²", "_rad_s": "rad/s", "_m_s": "m/s", "_rad": "rad", "_deg": "°", "_m": "m"}
"""Endings of the names of quantities."""
_TICKS = (0.01, 0.1, 0.3, 0.6, 1.0)


@style.style()
def score_bars(results: Results, _: style.Scene, *, measure: str) -> Figure | None:
    """Draw one bar per method, with a dot per seed, of the score with this measure; None for no score."""
    if not (scores := [score for score in results.scores if score.measure == measure]):
        return None
    score, rows = scores[0], results.tested()
    figure = Figure(figsize=(7.6, 0.9 + 0.38 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    drawn: dict[str, Artist] = {"mean over seeds": Patch(fc=style.FAINT, ec="none")}
    labels, drawn["95 % interval"] = [], Line2D([], [], color=style.INK, lw=1.6)
    for place, row in enumerate(rows):
        found, own = results.summary(row, measure), results.summary(row, measure, SIMULATED)
        # Beside the title, where no dot or diamond can stand in front of it or be taken for it.
        labels.append(f"{titled(row)}   {score.text(found.value) if found else '-'}")
        if found:
            bar: dict[str, Any] = {"color": style.method_color(row), "hatch": "////" if is_plus(row) else None}
            axes.barh(place, found.value, height=0.68, lw=0, zorder=2, ec=(1, 1, 1, 0.4), **bar)
            if found.low is not None and found.high is not None:
                axes.plot([found.low, found.high], [place, place], color=style.INK, lw=1.6, zorder=3)
            seeds = [*results.values(row, measure).values()]
            at = place + (np.linspace(-0.22, 0.22, len(seeds)) if len(seeds) > 1 else np.zeros(1))
            drawn["one seed"] = axes.plot(seeds, at, "o", mew=0.9, ms=3.5, zorder=4, **_DOT)[0]
        if own and score == results.headline:
            drawn["in its own simulator"] = axes.plot(own.value, place, "D", ms=5, zorder=5, **_DOT)[0]
    axes.set_yticks(range(len(rows)), labels)
    axes.tick_params(axis="y", length=0)
    axes.set(ylim=(len(rows) - 0.4, -0.6), xlabel=f"{score.quantity} {results.where}")
    if score.limit is not None:
        axes.set(xlim=(0, score.limit), xticks=np.linspace(0, score.limit, 6))
    axes.grid(visible=False, axis="y")
    axes.grid(visible=True, axis="x")
    figure.legend([*drawn.values()], [*drawn], loc="outside upper center", ncols=len(drawn), columnspacing=1.4)
    return figure


@style.style()
def learning_curves(results: Results, _: style.Scene) -> Figure | None:
    """Draw the headline score of training episodes over steps, by method: mean over seeds, band from worst to best."""
    curves = {}
    for row in results.rows:
        of = [one for one in results.trainings if (one.row, one.percent) == (row, results.largest)]
        seeds = [(np.array(one.steps), np.array(one.score)) for one in of]
        if seeds and all(np.isfinite(scores).any() for _, scores in seeds):
            curves[row] = seeds
    if not curves:
        return None
    panels = list(dict.fromkeys(map(base_method, curves)))
    columns = min(len(panels), PANELS_ACROSS)
    lines = -(-len(panels) // columns)
    figure = Figure(figsize=(0.6 + 2.1 * max(columns, 2), 0.6 + 1.7 * lines), layout="constrained")
    every = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for number, (axes, base) in enumerate(zip_longest(every, panels)):
        if base is None:
            axes.set_axis_off()
            continue
        axes.set_title(method_title(base), loc="left")
        axes.tick_params(labelbottom=number >= len(panels) - columns)
    for row, seeds in curves.items():
        axes = every[panels.index(base_method(row))]
        steps, scores = on_one_grid(seeds)
        style.draw_band(axes, steps, scores.mean(axis=0), scores.min(0), scores.max(0), **style.look(row))
    style.score_axis(every[0], results.headline)
    every[0].set_xlim(0, max(float(steps[-1]) for seeds in curves.values() for steps, _ in seeds))
    every[0].xaxis.set(major_formatter=EngFormatter(), major_locator=MaxNLocator(4))
    figure.supxlabel("steps of training")
    # In two lines, since a single row of panels is low.
    figure.supylabel(f"{results.headline.title} of training\nepisodes, from all starts")
    if any(map(is_plus, curves)):
        looks = {"without the plus settings": "-", "with the plus settings": "--"}
        handles = [Line2D([], [], color=style.INK, ls=dashes, label=label) for label, dashes in looks.items()]
        figure.legend(handles=handles, loc="outside upper center", ncols=2, handlelength=2.4)
    return figure


def on_one_grid(seeds: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Return steps (K,) that all seeds cover, and their scores there, (seeds, K)."""
    parts = [(steps[known], scores[known]) for steps, scores in seeds for known in [np.isfinite(scores)]]
    first, last = max(steps[0] for steps, _ in parts), min(steps[-1] for steps, _ in parts)
    grid = np.linspace(first, last, CURVE_POINTS)
    return grid, np.stack([np.interp(grid, steps, scores) for steps, scores in parts])


@style.style()
def data_efficiency(results: Results, scene: style.Scene) -> Figure | None:
    """Draw the headline score over the size of the dataset, under what each size covers (the paper's figure)."""
    percents, score = results.percents, results.headline
    if len(percents) < 2:
        return None
    covered = _covered(results, scene)
    ratios = [1.0] * len(covered) + [2.2]
    figure = Figure(figsize=(1.0 + 1.5 * max(4, len(percents)), 1.6 * sum(ratios)), layout="constrained")
    grid = figure.add_gridspec(len(ratios), len(percents), height_ratios=ratios)
    for line, (label, visits) in enumerate(covered.items()):
        first = figure.add_subplot(grid[line, 0])
        shared = {"sharex": first, "sharey": first}
        panels = [first, *(figure.add_subplot(grid[line, k], **shared) for k in range(1, len(percents)))]
        most = max(int(visit.counts.max()) for visit in visits)  # all have the colors of the one that covers most
        for axes, visit, percent in zip(panels, visits, percents, strict=True):
            style.draw_visits(axes, visit.counts, visit.extent, most)
            axes.tick_params(labelleft=axes is first, labelsize=6.5)
            axes.set_title("" if line else f"{percent} %")
        left, right, bottom, top = np.array([visit.extent for visit in visits]).T
        first.set(xlim=(left.min(), right.max()), ylim=(bottom.min(), top.max()), ylabel=label)
    axes = figure.add_subplot(grid[len(covered), :])
    for row in results.tested():
        every = {percent: results.score_of(row, TESTED, percent) for percent in percents}
        known = {percent: one for percent, one in every.items() if one}
        bands = np.array([(one.value, one.low, one.high) for one in known.values()], np.float64).T
        style.draw_band(axes, np.array([*known]), *bands, marker="o", ms=4, **style.look(row))
        for percent in known:
            seeds = [*results.values(row, score.measure, TESTED, percent).values()]
            axes.plot([percent] * len(seeds), seeds, ".", color=style.method_color(row), alpha=0.45, ms=4)
    axes.set_xticks(percents, [f"{percent} %" for percent in percents])
    axes.set(xlabel="size of the dataset", ylabel=f"{score.quantity} {results.where}")
    style.score_axis(axes, score)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
    return figure


def _covered(results: Results, scene: style.Scene) -> Mapping[str, list[Map]]:
    """Return the visits of each size of the first seed that has all of them; empty without one."""
    roles = {"position (m)": "position", "velocity (m/s)": "vector"}
    for seed in results.seeds:
        folders = [scene.root / artifact_key("subset", "", seed, percent) for percent in results.percents]
        if all(folder.is_dir() for folder in folders):
            datasets = [Dataset.open(folder) for folder in folders]
            found = {label: [visited(dataset, role) for dataset in datasets] for label, role in roles.items()}
            return {label: [one for one in of if one] for label, of in found.items() if all(of)}
    return {}


@style.style()
def open_loop_error(results: Results, _: style.Scene) -> Figure | None:
    """Draw the error over the horizon, one panel per quantity (named with its unit), on logarithmic axes."""
    means = results.mean_errors()
    if means.empty:
        return None
    rows = [row for row in results.groundings() if (row, "grounded") in means.index]
    quantities = list(dict.fromkeys(means.index.get_level_values("quantity")))
    horizons = means.index.get_level_values("horizon").unique()
    figure = Figure(figsize=(1.7 + 2.9 * len(quantities), 3.3), layout="constrained")
    grid = figure.subplots(1, len(quantities), squeeze=False)[0]
    for axes, quantity in zip(grid, quantities, strict=True):
        drawn: list[Floats] = []
        for row in rows:
            raw = means.loc[(row, "raw", quantity)]
            values = raw.to_numpy().T
            if not any(np.allclose(values, seen, rtol=SAME, equal_nan=True) for seen in drawn):
                label = None if drawn else "no grounding"
                style.draw_band(axes, raw.index, *values, color=style.INK, ls=":", label=label, marker="o", ms=3.5)
                drawn.append(values)
        for row in rows:
            band = means.loc[(row, "grounded", quantity)]
            style.draw_band(axes, band.index, *band.to_numpy().T, **style.look(row), marker="o", ms=3.5)
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


@style.style()
def reliability(parts: Mapping[str, Mapping[str, Floats]]) -> Figure:
    """Draw observed against predicted rates of `parts`, by their square roots, above the number of steps at each."""

    def root(values: Floats) -> Floats:
        return np.asarray(np.sqrt(np.maximum(values, 0.0)))

    figure = Figure(figsize=(1.9 + 2.7 * len(parts), 4.2), layout="constrained")
    above, below = figure.subplots(2, len(parts), squeeze=False, sharex=True, sharey="row", height_ratios=[2.6, 1.0])
    handles: dict[str, Line2D] = {}
    for (title, rates), axes, counts in zip(parts.items(), above, below, strict=True):
        axes.plot([0, 1], [0, 1], color=style.FAINT, ls="--", lw=0.9, zorder=1)
        for row, (predicted, observed, steps) in rates.items():
            drawn = axes.plot(predicted, observed, marker="o", ms=4, clip_on=False, **style.look(row))
            handles.setdefault(method_title(row), drawn[0])
            counts.plot(predicted, steps, marker="o", ms=4, **style.look(row))
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


@style.style()
def predictive_validity(results: Results, _: style.Scene) -> Figure | None:
    """Draw the return in the target against that in each simulator; on the dashed line they are equal."""
    worlds = [world for world in SHARED_WORLDS if any(line.where == world for line in results.lines)]
    if results.tested_in != "target" or not worlds:
        return None
    rows = results.tested()
    figure = Figure(figsize=(2.4 + 3.0 * len(worlds), max(3.7, 0.6 + 0.19 * len(rows))), layout="constrained")
    grid = figure.subplots(1, len(worlds), squeeze=False, sharey=True)[0]
    handles: dict[str, Line2D] = {}
    for axes, world in zip(grid, worlds, strict=True):
        axes.axline((0, 0), slope=1, color=style.FAINT, ls="--", lw=0.9, zorder=1)
        for row in rows:
            target, there = results.values(row, "return"), results.values(row, "return", world)
            if shared := [seed for seed in there if seed in target]:
                sides = ([of[seed] for seed in shared] for of in (there, target))
                drawing = {"color": style.method_color(row), "mec": "white", "mew": 0.6, "ms": 6}
                drawn = axes.plot(*sides, "^" if is_plus(row) else "o", **drawing)
                handles[method_title(row)] = drawn[0]
        axes.set_title(f"{world} simulator".capitalize(), loc="left")
        axes.set_xlabel("return in this simulator")
        axes.grid(visible=True, axis="both")
    grid[0].set_ylabel("return in the target")
    figure.legend([*handles.values()], [*handles], loc="outside right center")
    return figure
