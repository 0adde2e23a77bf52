"""Where a dataset's positions lie."""

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from astra_data.figures.style import style

Floats = NDArray[np.float64]


def coverage(counts: Floats, edges: tuple[Floats, Floats], labels: tuple[str, str]) -> Figure:
    """Draw how many steps fall into each cell of the plane.

    Args:
        counts: steps per cell, (cells along x, cells along y).
        edges: of the cells along x, (cells + 1,), and along y.
        labels: of the two axes.
    """
    with style():
        figure = Figure(figsize=(5.4, 4.2), layout="constrained")
        axes = figure.subplots()
        mesh = axes.pcolormesh(
            *edges, np.where(counts > 0, counts, np.nan).T, norm=LogNorm(vmin=1), cmap="viridis"
        )
        axes.set_aspect("equal")
        axes.grid(visible=False)
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        figure.colorbar(mesh, ax=axes, label="steps per cell")
        return figure
