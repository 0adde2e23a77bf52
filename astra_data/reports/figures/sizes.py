"""A score over the size of the dataset, under what each size covers (the paper's data-efficiency figure)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from astra_data.core.arrays import Floats
from astra_data.core.naming import is_plus
from astra_data.dataset.inspection import Map
from astra_data.reports.figures.coverage import draw_visits
from astra_data.reports.figures.style import method_color, method_title, score_axis, style
from astra_data.worlds.score import Score


@dataclass(frozen=True)
class Scored:
    """A score of one row at one size.

    Attributes:
        seeds: of each seed, (seeds,).
        middle: the interquartile mean.
        low, high: ends of its interval, NaN for a single seed.
    """

    seeds: Floats
    middle: float
    low: float
    high: float


def data_efficiency(
    score: Score,
    percents: Sequence[int],
    rows: Mapping[str, Mapping[int, Scored]],
    covered: Mapping[str, Sequence[Map]],
    tested: str = "in the target",
) -> Figure:
    """Draw a map per size for each of `covered`, and below them a score with a band per row.

    Args:
        score: what is drawn over the size.
        percents: the sizes.
        rows: the scores of each row by size, as far as there are any.
        covered: what is mapped, such as "position (m)" → the visits of each size.
        tested: where.
    """
    with style():
        order = np.argsort(percents)
        ratios = [1.0] * len(covered) + [2.2]
        figure = Figure(figsize=(1.0 + 1.5 * max(4, len(percents)), 1.6 * sum(ratios)), layout="constrained")
        grid = figure.add_gridspec(len(ratios), len(percents), height_ratios=ratios)
        for row, (label, visits) in enumerate(covered.items()):
            first = figure.add_subplot(grid[row, 0])
            panels = [first]
            panels += [
                figure.add_subplot(grid[row, k], sharex=first, sharey=first) for k in range(1, len(percents))
            ]
            _maps(panels, [visits[k] for k in order], label)
            if row == 0:
                for axes, k in zip(panels, order, strict=True):
                    axes.set_title(f"{percents[k]} %")
        axes = figure.add_subplot(grid[len(covered), :])
        for method, sizes in rows.items():
            _band(axes, sizes, method)
        axes.set_xticks(sorted(percents), [f"{percent} %" for percent in sorted(percents)])
        axes.set_xlabel("size of the dataset")
        score_axis(axes, score)
        axes.set_ylabel(f"{score.quantity} {tested}")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
        return figure


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


def _band(axes: Axes, sizes: Mapping[int, Scored], method: str) -> None:
    percents = sorted(sizes)
    scored = [sizes[percent] for percent in percents]
    low, high = [one.low for one in scored], [one.high for one in scored]
    color, dashes = method_color(method), "--" if is_plus(method) else "-"
    if np.isfinite(low).all():
        axes.fill_between(percents, low, high, color=color, alpha=0.18, lw=0)
    middle = [one.middle for one in scored]
    axes.plot(percents, middle, dashes, color=color, marker="o", ms=4, label=method_title(method))
    places = np.repeat(percents, [len(one.seeds) for one in scored])
    seeds = np.concatenate([one.seeds for one in scored])
    axes.plot(places, seeds, ".", color=color, alpha=0.45, ms=4, zorder=1)
