"""Where another episode would teach most."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from astra_data.core.arrays import Floats
from astra_data.reports.figures.motion import draw_walls
from astra_data.reports.figures.style import INK, SIMULATED, style
from astra_data.worlds.plane.mazes import Maze


def information_map(
    maps: dict[str, dict[str, Any]], starts: Floats, paths: Floats, maze: Maze | None = None
) -> Figure:
    """Draw what a step teaches by state and by command, and on the former the episodes that are suggested.

    Args:
        maps: "state" and "command", each with "axes", "edges", and "information" in nats, [first, second
            axis], None where nothing is known; a map of one axis is a strip.
        starts: of the episodes, (E, X).
        paths: their expected states, (E, T, X); NaN after the end.
        maze: drawn behind the states, if there is one.
    """
    with style():
        figure = Figure(figsize=(8.4, 4.0), layout="constrained")
        first, second = figure.subplots(1, 2, width_ratios=[1.3, 1.0])
        for axes, name in ((first, "state"), (second, "command")):
            image = _cells(axes, maps[name])
            figure.colorbar(image, ax=axes, label="information per step (nats)", shrink=0.8)
        height = np.zeros(len(starts)) if len(maps["state"]["axes"]) == 1 else starts[:, 1]
        for path in paths:
            across = np.zeros(len(path)) if path.shape[1] == 1 else path[:, 1]
            first.plot(path[:, 0], across, color=SIMULATED, lw=0.8, alpha=0.8)
        first.plot(starts[:, 0], height, "o", color="white", mec=INK, ms=4.5, mew=1.0, ls="", zorder=5)
        first.set_title("by state, with suggested episodes", loc="left")
        second.set_title("by command", loc="left")
        if maze is not None:
            draw_walls(first, maze)
    return figure


def _cells(axes: Axes, found: dict[str, Any]) -> Any:  # noqa: ANN401 - an image of matplotlib
    mean = np.array(found["information"], dtype=np.float64)
    edges = [np.array(each) for each in found["edges"]]
    if mean.ndim == 1:
        mean, edges = mean[:, None], [edges[0], np.array([-0.5, 0.5])]
        axes.set_yticks([])
    image = axes.pcolormesh(*edges, mean.T, cmap="viridis", rasterized=True)
    axes.grid(visible=False)
    axes.set_xlabel(found["axes"][0])
    if len(found["axes"]) > 1:
        axes.set_ylabel(found["axes"][1])
    return image
