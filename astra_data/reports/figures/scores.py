"""Scores of each row: final, and during training."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from astra_data.core.arrays import Floats
from astra_data.core.naming import base_method, is_plus
from astra_data.reports.figures.style import FAINT, INK, method_color, method_title, score_axis, style
from astra_data.worlds.score import Score

CURVE_POINTS = 200
"""Points at which curves of different seeds are interpolated."""

PANELS_ACROSS = 4
"""Learning-curve panels side by side, at most."""


@dataclass(frozen=True)
class Curve:
    """One seed's training.

    Attributes:
        steps: simulator steps so far, (K,), increasing.
        score: of the training episodes that ended, (K,); NaN where none ended.
    """

    steps: Floats
    score: Floats


def score_bars(
    score: Score,
    scores: Mapping[str, Floats],
    intervals: Mapping[str, tuple[float, float, float]],
    simulated: Mapping[str, float],
    where: str = "in the target",
) -> Figure:
    """Draw one bar per row, with a dot per seed.

    Args:
        score: what is drawn.
        scores: those of each row's seeds, (seeds,).
        intervals: (interquartile mean, low, high) of each row; low and high are NaN for a single seed.
        simulated: mean score of a row in the simulator that it was trained in, if any.
        where: the scores were measured.
    """
    with style():
        figure = Figure(figsize=(7.6, 0.9 + 0.38 * len(scores)), layout="constrained")
        axes = figure.add_subplot()
        for place, (method, seeds) in enumerate(scores.items()):
            _bar(axes, place, method, score, seeds, intervals[method])
            if method in simulated:
                (diamond,) = axes.plot(simulated[method], place, "D", mfc="white", mec=INK, ms=5, zorder=5)
                diamond.set_clip_on(False)
        axes.set_yticks(range(len(scores)), [_tick_label(method) for method in scores])
        axes.tick_params(axis="y", length=0)
        axes.set_ylim(len(scores) - 0.4, -0.6)
        if score.limit is not None:
            axes.set_xlim(0, score.limit)
            axes.set_xticks(np.linspace(0, score.limit, 6))
        axes.set_xlabel(f"{score.quantity} {where}")
        axes.grid(visible=False, axis="y")
        axes.grid(visible=True, axis="x")
        handles = [
            Patch(fc=FAINT, ec="none", label="interquartile mean over seeds"),
            Line2D([], [], color=INK, lw=1.6, label="95 % interval"),
            Line2D([], [], marker="o", ls="", mfc="white", mec=INK, mew=0.9, ms=4.5, label="one seed"),
        ]
        if simulated:
            handles.append(
                Line2D([], [], marker="D", ls="", mfc="white", mec=INK, ms=5, label="in its own simulator")
            )
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), columnspacing=1.4)
        return figure


def learning_curves(score: Score, curves: Mapping[str, Sequence[Curve]]) -> Figure:
    """Draw a score of the training episodes over steps: mean over seeds, band from the worst to the best.

    Each method has a panel; its row with the [plus] settings is dashed.

    Args:
        score: what is drawn.
        curves: each row's seeds, at least one.
    """
    with style():
        panels = list(dict.fromkeys(map(base_method, curves)))
        columns = min(len(panels), PANELS_ACROSS)
        lines = -(-len(panels) // columns)
        figure = Figure(figsize=(0.6 + 2.1 * max(columns, 2), 0.6 + 1.7 * lines), layout="constrained")
        every = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
        for axes, base in zip(every, panels, strict=False):
            axes.set_title(method_title(base), loc="left")
        for axes in every[len(panels) :]:
            axes.set_axis_off()
        for axes in every[max(0, len(panels) - columns) : len(panels)]:
            axes.tick_params(labelbottom=True)
        for method, seeds in curves.items():
            axes = every[panels.index(base_method(method))]
            steps, scores = on_one_grid(seeds)
            color, dashes = method_color(method), "--" if is_plus(method) else "-"
            if len(seeds) > 1:
                low, high = scores.min(axis=0), scores.max(axis=0)
                axes.fill_between(steps, low, high, color=color, alpha=0.15, lw=0)
            axes.plot(steps, scores.mean(axis=0), dashes, color=color)
        score_axis(every[0], score)
        every[0].set_xlim(0, max(float(seed.steps[-1]) for seeds in curves.values() for seed in seeds))
        every[0].xaxis.set_major_formatter(_steps_label)
        every[0].xaxis.set_major_locator(MaxNLocator(4))
        figure.supxlabel("steps of training")
        # In two lines, since a single row of panels is low.
        figure.supylabel(f"{score.title} of training\nepisodes, from all starts")
        if any(map(is_plus, curves)):
            handles = [
                Line2D([], [], color=INK, label="without the [plus] settings"),
                Line2D([], [], color=INK, ls="--", label="with the [plus] settings"),
            ]
            figure.legend(handles=handles, loc="outside upper center", ncols=2, handlelength=2.4)
        return figure


def _bar(
    axes: Axes, place: int, method: str, score: Score, seeds: Floats, interval: tuple[float, float, float]
) -> None:
    iqm, low, high = interval
    hatch = "////" if is_plus(method) else None
    axes.barh(
        place, iqm, height=0.68, color=method_color(method), ec=(1, 1, 1, 0.4), lw=0, hatch=hatch, zorder=2
    )
    if np.isfinite(low):
        axes.plot([low, high], [place, place], color=INK, lw=1.6, zorder=3)
    spread = np.linspace(-0.22, 0.22, len(seeds)) if len(seeds) > 1 else np.zeros(1)
    # Not clipped: the axis would cut what lies on 0 in half.
    (dots,) = axes.plot(seeds, place + spread, "o", mfc="white", mec=INK, mew=0.9, ms=3.5, zorder=4)
    dots.set_clip_on(False)
    # Beyond the axis, where neither dots nor diamonds can cover the number.
    axes.annotate(
        score.text(iqm),
        (1, place),
        xycoords=axes.get_yaxis_transform(),
        xytext=(10, 0),
        textcoords="offset points",
        ha="left",
        va="center",
        fontweight="bold",
        fontsize=9.5,
        annotation_clip=False,
    )


def _tick_label(method: str) -> str:
    from astra_data.methods import method_role

    title = method_title(method)
    return f"{title} ({role})" if (role := method_role(method)) else title


def on_one_grid(seeds: Sequence[Curve]) -> tuple[Floats, Floats]:
    """Return steps (K,) that all seeds cover, and their scores there, (seeds, K)."""
    known = [np.isfinite(seed.score) for seed in seeds]
    parts = [(seed.steps[keep], seed.score[keep]) for seed, keep in zip(seeds, known, strict=True)]
    first, last = max(steps[0] for steps, _ in parts), min(steps[-1] for steps, _ in parts)
    grid = np.linspace(first, last, CURVE_POINTS)
    return grid, np.stack([np.interp(grid, steps, scores) for steps, scores in parts])


def _steps_label(steps: float, _: float) -> str:
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(steps) >= size:
            return f"{steps / size:g} {unit}"
    return f"{steps:g}"
