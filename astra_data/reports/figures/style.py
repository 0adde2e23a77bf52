"""What all figures share: a style, each method's color and title, what they draw besides results."""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.style import context
from PIL import Image

from astra_data.core.arrays import Floats, Ints
from astra_data.core.naming import artifact_key, base_method, is_plus
from astra_data.reports.artifacts import TRAJECTORIES

if TYPE_CHECKING:  # these load torch, which a dataset's figures can do without
    from astra_data.reports.results import Results
    from astra_data.worlds.objective import Score
    from astra_data.worlds.task import Task

SPARE_COLORS = ("#882255", "#332288", "#661100", "#6699CC", "#88CCEE")
"""For methods without a color of their own. The others are Okabe and Ito's palette and shades that color-blind readers
can tell from it."""
SIMULATED, DEPLOYED = "#E07B00", "#0060A8"
"""A simulator and the target environment, in every figure (as in the paper's Fig. 3)."""
INK, FAINT, WALL = "#2B2B2B", "#8A8A8A", "#D9D9D6"

_STYLE = Path(__file__).with_name("astra_data.mplstyle")


@dataclass(frozen=True)
class Scene:
    """What figures are drawn from besides the results: `episodes` of each of `methods`, by default of all."""

    root: Path
    task: "Task"
    methods: tuple[str, ...] = ()
    episodes: int = 12

    def folders(self, results: "Results") -> dict[str, Path]:
        """Return method → evaluation of its first seed with trajectories; empty if any method has none."""
        rows = [row for row in self.methods if row in results.tested()] or results.tested()
        found = {}
        for row in rows:
            folders = (self.root / artifact_key("evaluate", row, seed) for seed in results.seeds)
            found[row] = next((folder for folder in folders if (folder / TRAJECTORIES).exists()), None)
        return {row: folder for row, folder in found.items() if folder and None not in found.values()}


@contextmanager
def style() -> Iterator[None]:
    """Draw in the figures' style, whatever the caller's matplotlib settings are."""
    with context(_STYLE, after_reset=True):
        yield


def method_color(method: str) -> str:
    """Return the color of a row as "#rrggbb": a variant's is its base row's, darker."""
    from astra_data.methods import METHODS

    base = base_method(method)
    own = METHODS[base].color if base in METHODS else ""
    color = own or SPARE_COLORS[zlib.crc32(base.encode()) % len(SPARE_COLORS)]
    if is_plus(method):
        red, green, blue = to_rgb(color)
        return to_hex((0.68 * red, 0.68 * green, 0.68 * blue))
    return color.lower()


def look(row: str) -> dict[str, Any]:
    """Return color, dashes and label of a method's lines."""
    from astra_data.methods import method_title

    return {"color": method_color(row), "ls": "--" if is_plus(row) else "-", "label": method_title(row)}


def draw_band(axes: Axes, at: Floats, mean: Floats, low: Floats, high: Floats, **look: Any) -> None:
    """Draw a line over a band between `low` and `high`; all are of the same shape (K,)."""
    axes.fill_between(at, low, high, color=look["color"], alpha=0.15, lw=0)
    axes.plot(at, mean, **look)


def score_axis(axes: Axes, score: "Score") -> None:
    """Start the vertical axis at a score of zero, and end it at the limit if there is one."""
    axes.set_ylim(*((0, None) if score.limit is None else (-0.02 * score.limit, 1.02 * score.limit)))


def png(figure: Figure) -> bytes:
    """Render a figure as PNG of 256 colors (a fifth of the bytes of all colors), without a display."""
    drawn, small = BytesIO(), BytesIO()
    with style():
        figure.savefig(drawn, format="png")
    with Image.open(drawn) as picture:
        palette = picture.convert("RGB").quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    palette.save(small, format="png", optimize=True)
    return small.getvalue()


@style()
def coverage(counts: Ints, extent: tuple[float, float, float, float], label: str, unit: str) -> Figure:
    """Draw how often the cells [y, x] of a plane, from the lower left, were visited; those never visited stay white."""
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
    shown, norm = np.where(counts > 0, counts, np.nan), LogNorm(vmin=1, vmax=max(2, most))
    return axes.imshow(shown, origin="lower", extent=extent, cmap="viridis", norm=norm, interpolation="nearest")
