"""Episodes as strips of pictures, a strip per method."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from astra_data.reports.figures.style import FAINT, method_color, method_title, style


@dataclass(frozen=True)
class Strip:
    """One episode.

    Attributes:
        pictures: (K, height, width, 3), at the first K of all times; the episode was over at the others.
        ended_s: when the episode ended.
        failed: whether it ended in failure.
    """

    pictures: NDArray[np.uint8]
    ended_s: float
    failed: bool


def strips(times_s: Sequence[float], rows: Mapping[str, Strip]) -> Figure:
    """Draw a row of pictures per method, taken at the same times, and the time when its episode ended.

    Args:
        times_s: from the start, one for each column.
        rows: method → its strip.
    """
    height, width = next(iter(rows.values())).pictures.shape[1:3]
    wide = 0.95
    with style():
        size = (1.7 + wide * len(times_s), 0.3 + wide * height / width * len(rows))
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(rows), len(times_s), squeeze=False)
        for line, (method, strip) in zip(grid, rows.items(), strict=True):
            for axes in line:
                axes.set_axis_off()
            for axes, picture in zip(line, strip.pictures, strict=False):
                axes.imshow(picture)
            ended = f"fell after {strip.ended_s:.1f} s" if strip.failed else f"{strip.ended_s:.0f} s"
            place = {"transform": line[0].transAxes, "ha": "right"}
            name = method_title(method).replace(" + ", " +\n").replace(", ", ",\n")
            line[0].text(-0.08, 0.55, name, va="bottom", weight="bold", color=method_color(method), **place)
            line[0].text(-0.08, 0.5, ended, va="top", color=FAINT, size=8, **place)
        for axes, time_s in zip(grid[0], times_s, strict=True):
            axes.set_title(f"{time_s:g} s", size=8, weight="normal")
        return figure
