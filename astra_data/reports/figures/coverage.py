"""What a dataset covers: visited positions and velocities (the paper's data-efficiency figure)."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from astra_data.core.arrays import Ints
from astra_data.reports.figures.style import style


def coverage(counts: Ints, extent: tuple[float, float, float, float], label: str, unit: str) -> Figure:
    """Draw how often the cells of a plane were visited; those never visited stay white.

    Args:
        counts: indexed [y, x] from the lower left, (height, width).
        extent: left, right, bottom and top edge.
        label: what the plane is: "position" or "velocity".
        unit: of both axes.
    """
    with style():
        figure = Figure(figsize=(4.2, 3.6), layout="constrained")
        axes = figure.subplots()
        image = draw_visits(axes, counts, extent, int(counts.max()))
        axes.set_xlabel(f"x {label} ({unit})")
        axes.set_ylabel(f"y {label} ({unit})")
        figure.colorbar(image, ax=axes, label="steps")
    return figure


def draw_visits(axes: Axes, counts: Ints, extent: tuple[float, float, float, float], most: int) -> AxesImage:
    """Draw `counts` on a logarithmic scale from 1 to `most`, but to 2 at least; others as in `coverage`."""
    axes.grid(visible=False)
    return axes.imshow(
        np.where(counts > 0, counts, np.nan),
        origin="lower",
        extent=extent,
        cmap="viridis",
        norm=LogNorm(vmin=1, vmax=max(2, most)),
        interpolation="nearest",
    )
