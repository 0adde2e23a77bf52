"""Scores of each method: final, during training, and over the size of the dataset."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from astra_data.core.arrays import Floats
from astra_data.core.naming import artifact_key, base_method, is_plus
from astra_data.dataset.inspection import Map, visited
from astra_data.dataset.reader import Dataset
from astra_data.methods import method_title
from astra_data.reports.figures.style import (
    FAINT,
    INK,
    Scene,
    draw_band,
    draw_visits,
    look,
    method_color,
    score_axis,
    style,
)
from astra_data.reports.results import SIMULATED, TESTED, Results, titled

CURVE_POINTS = 200  # points at which curves of different seeds are interpolated
PANELS_ACROSS = 4  # learning-curve panels side by side, at most
_DOT: dict[str, Any] = {"mfc": "white", "mec": INK, "clip_on": False}
"""Not clipped: the axis would cut what lies on 0 in half."""


def score_bars(measure: str) -> Callable[[Results, Scene], Figure | None]:
    """Return how to draw one bar per method, with a dot per seed, of the score with this measure."""

    def draw(results: Results, _: Scene) -> Figure | None:
        score = next((score for score in results.scores if score.measure == measure), None)
        if score is None:
            return None
        rows = results.tested()
        with style():
            figure = Figure(figsize=(7.6, 0.9 + 0.38 * len(rows)), layout="constrained")
            axes = figure.add_subplot()
            labels, drawn = [], dict[str, Artist]()
            drawn["mean over seeds"] = Patch(fc=FAINT, ec="none")
            drawn["95 % interval"] = Line2D([], [], color=INK, lw=1.6)
            for place, row in enumerate(rows):
                found, own = results.summary(row, measure), results.summary(row, measure, SIMULATED)
                # Beside the title, where no dot or diamond can stand in front of it or be taken for it.
                labels.append(f"{titled(row)}   {score.text(found.value) if found else '-'}")
                if found:
                    hatch = "////" if is_plus(row) else None
                    bar: dict[str, Any] = {"color": method_color(row), "ec": (1, 1, 1, 0.4), "hatch": hatch}
                    axes.barh(place, found.value, height=0.68, lw=0, zorder=2, **bar)
                    if found.low is not None and found.high is not None:
                        axes.plot([found.low, found.high], [place, place], color=INK, lw=1.6, zorder=3)
                    seeds = [*results.values(row, measure).values()]
                    at = place + (np.linspace(-0.22, 0.22, len(seeds)) if len(seeds) > 1 else np.zeros(1))
                    drawn["one seed"] = axes.plot(seeds, at, "o", mew=0.9, ms=3.5, zorder=4, **_DOT)[0]
                if own and score == results.headline:
                    drawn["in its own simulator"] = axes.plot(own.value, place, "D", ms=5, zorder=5, **_DOT)[0]
            axes.set_yticks(range(len(rows)), labels)
            axes.tick_params(axis="y", length=0)
            axes.set_ylim(len(rows) - 0.4, -0.6)
            if score.limit is not None:
                axes.set_xlim(0, score.limit)
                axes.set_xticks(np.linspace(0, score.limit, 6))
            axes.set_xlabel(f"{score.quantity} {results.where}")
            axes.grid(visible=False, axis="y")
            axes.grid(visible=True, axis="x")
            names = [*drawn]
            figure.legend([*drawn.values()], names, loc="outside upper center", ncols=len(names), columnspacing=1.4)
            return figure

    return draw


def learning_curves(results: Results, _: Scene) -> Figure | None:
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
    with style():
        figure = Figure(figsize=(0.6 + 2.1 * max(columns, 2), 0.6 + 1.7 * lines), layout="constrained")
        every = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
        for axes, base in zip(every, panels, strict=False):
            axes.set_title(method_title(base), loc="left")
        for axes in every[len(panels) :]:
            axes.set_axis_off()
        for axes in every[max(0, len(panels) - columns) : len(panels)]:
            axes.tick_params(labelbottom=True)
        for row, seeds in curves.items():
            axes = every[panels.index(base_method(row))]
            steps, scores = on_one_grid(seeds)
            draw_band(axes, steps, scores.mean(axis=0), scores.min(0), scores.max(0), **look(row))
        score_axis(every[0], results.headline)
        every[0].set_xlim(0, max(float(steps[-1]) for seeds in curves.values() for steps, _ in seeds))
        every[0].xaxis.set_major_formatter(_steps_label)
        every[0].xaxis.set_major_locator(MaxNLocator(4))
        figure.supxlabel("steps of training")
        # In two lines, since a single row of panels is low.
        figure.supylabel(f"{results.headline.title} of training\nepisodes, from all starts")
        if any(map(is_plus, curves)):
            looks = {"without the plus settings": "-", "with the plus settings": "--"}
            handles = [Line2D([], [], color=INK, ls=dashes, label=label) for label, dashes in looks.items()]
            figure.legend(handles=handles, loc="outside upper center", ncols=2, handlelength=2.4)
        return figure


def on_one_grid(seeds: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Return steps (K,) that all seeds cover, and their scores there, (seeds, K)."""
    parts = [(steps[known], scores[known]) for steps, scores in seeds for known in [np.isfinite(scores)]]
    first, last = max(steps[0] for steps, _ in parts), min(steps[-1] for steps, _ in parts)
    grid = np.linspace(first, last, CURVE_POINTS)
    return grid, np.stack([np.interp(grid, steps, scores) for steps, scores in parts])


def _steps_label(steps: float, _: float) -> str:
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(steps) >= size:
            return f"{steps / size:g} {unit}"
    return f"{steps:g}"


def data_efficiency(results: Results, scene: Scene) -> Figure | None:
    """Draw the headline score over the size of the dataset, under what each size covers (the paper's figure)."""
    percents, score = results.percents, results.headline
    if len(percents) < 2:
        return None
    covered = _covered(results, scene)
    with style():
        ratios = [1.0] * len(covered) + [2.2]
        figure = Figure(figsize=(1.0 + 1.5 * max(4, len(percents)), 1.6 * sum(ratios)), layout="constrained")
        grid = figure.add_gridspec(len(ratios), len(percents), height_ratios=ratios)
        for line, (label, visits) in enumerate(covered.items()):
            first = figure.add_subplot(grid[line, 0])
            shared = {"sharex": first, "sharey": first}
            others = [figure.add_subplot(grid[line, k], **shared) for k in range(1, len(percents))]
            _maps([first, *others], visits, label)
            for axes, percent in zip([first, *others], percents if line == 0 else (), strict=False):
                axes.set_title(f"{percent} %")
        axes = figure.add_subplot(grid[len(covered), :])
        for row in results.tested():
            every = {percent: results.score_of(row, TESTED, percent) for percent in percents}
            known = {percent: one for percent, one in every.items() if one}
            bands = np.array([(one.value, one.low, one.high) for one in known.values()], np.float64).T
            draw_band(axes, np.array([*known]), *bands, marker="o", ms=4, **look(row))
            for percent in known:
                seeds = [*results.values(row, score.measure, TESTED, percent).values()]
                axes.plot([percent] * len(seeds), seeds, ".", color=method_color(row), alpha=0.45, ms=4)
        axes.set_xticks(percents, [f"{percent} %" for percent in percents])
        axes.set_xlabel("size of the dataset")
        score_axis(axes, score)
        axes.set_ylabel(f"{score.quantity} {results.where}")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
        return figure


def _covered(results: Results, scene: Scene) -> Mapping[str, list[Map]]:
    """Return the visits of each size of the first seed that has all of them; empty without one."""
    roles = {"position (m)": "position", "velocity (m/s)": "vector"}
    for seed in results.seeds:
        folders = [scene.root / artifact_key("subset", "", seed, percent) for percent in results.percents]
        if all(folder.is_dir() for folder in folders):
            datasets = [Dataset.open(folder) for folder in folders]
            found = {label: [visited(dataset, role) for dataset in datasets] for label, role in roles.items()}
            return {label: [one for one in of if one] for label, of in found.items() if all(of)}
    return {}


def _maps(panels: Sequence[Axes], visits: Sequence[Map], label: str) -> None:
    """Draw one map per panel, with the colors and the limits of the one that covers most."""
    most = max(int(visit.counts.max()) for visit in visits)
    extents = np.array([visit.extent for visit in visits])
    for axes, visit in zip(panels, visits, strict=True):
        draw_visits(axes, visit.counts, visit.extent, most)
        axes.tick_params(labelleft=axes is panels[0], labelsize=6.5)
    panels[0].set_xlim(extents[:, 0].min(), extents[:, 1].max())
    panels[0].set_ylim(extents[:, 2].min(), extents[:, 3].max())
    panels[0].set_ylabel(label)
