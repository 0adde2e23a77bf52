"""How well models predict a recorded walk: error over the horizon, and over the size of the training data."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from astra_data.core.arrays import Floats
from astra_data.reports.figures.style import style

Bands = Mapping[str, Mapping[str, Floats]]
"""Axis → model → error, low and high, (3, K)."""

LABELS = {
    "forward_m": "forward (m)",
    "left_m": "left (m)",
    "turn_rad": "turn (rad)",
    "all_joints": "all joints",
}
RAW = "raw"


def walk_prediction(
    horizons_s: Sequence[float],
    by_horizon: Bands,
    minutes: Sequence[float],
    by_minutes: Bands,
    horizon_s: float,
    looks: Mapping[str, tuple[str, str]],
) -> Figure:
    """Draw a column per axis: RMS error by horizon; below, with several data sizes, by size.

    Args:
        horizons_s: the K horizons.
        by_horizon: errors of the models fitted to all the data.
        minutes: the M sizes of the data.
        by_minutes: errors at `horizon_s`.
        horizon_s: the horizon of the lower row.
        looks: title and color of each model.
    """
    with style():
        rows = 2 if len(minutes) > 1 else 1
        figure = Figure(figsize=(1.9 + 2.5 * len(by_horizon), 0.4 + 2.5 * rows), layout="constrained")
        grid = figure.subplots(rows, len(by_horizon), squeeze=False)
        for column, (axis, bands) in enumerate(by_horizon.items()):
            upper = grid[0, column]
            _lines(upper, np.array(horizons_s), bands, looks)
            upper.set_title(LABELS.get(axis, axis))
            upper.set_xlabel("horizon (s)")
            if rows > 1:
                _lines(grid[1, column], np.array(minutes), by_minutes[axis], looks)
                grid[1, column].set(xscale="log", xlabel="minutes of training data")
                grid[1, column].set_xticks(minutes, [f"{size:.3g}" for size in minutes])
                grid[1, column].minorticks_off()
        grid[0, 0].set_ylabel("RMS error")
        if rows > 1:
            grid[1, 0].set_ylabel(f"RMS error after {horizon_s:g} s")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right center")
        return figure


def _lines(
    axes: Axes, places: Floats, bands: Mapping[str, Floats], looks: Mapping[str, tuple[str, str]]
) -> None:
    for name, (middle, low, high) in bands.items():
        title, color = looks[name]
        axes.fill_between(places, low, high, color=color, alpha=0.08, lw=0)
        axes.plot(places, middle, ":" if name == RAW else "-", color=color, marker="o", ms=3, label=title)
    axes.set_ylim(bottom=0)
