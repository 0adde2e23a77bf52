from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from fake_runs import line, results
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

from astra_data.methods import METHODS
from astra_data.reports.figures.charts import score_bars
from astra_data.reports.figures.style import Scene, coverage, method_color, png, style
from astra_data.robots.registry import TASKS

ROWS = ("direct_transfer", "nas", "astra", "direct_transfer_plus", "nas_plus", "astra_plus", "follower")


def bars(*rows: str) -> Figure:
    found = results(*(line(row, 0, success=0.5) for row in rows))
    figure = score_bars(found, Scene(Path(), TASKS["antmaze-umaze"]), measure="success")
    assert figure is not None
    return figure


def test_every_row_has_its_own_color_and_a_plus_row_its_base_rows_darker() -> None:
    assert len({method_color(row) for row in ROWS}) == len(ROWS)
    for base in (*METHODS, "my_own"):
        light, dark = to_rgb(method_color(base)), to_rgb(method_color(f"{base}_plus"))
        assert sum(dark) < sum(light) and dark == pytest.approx([0.68 * channel for channel in light], abs=0.01)
    assert method_color("my_own") == method_color("my_own")


def test_drawing_leaves_the_callers_settings_alone_and_needs_no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    before = dict(matplotlib.rcParams)
    assert png(bars("nas")).startswith(b"\x89PNG") and dict(matplotlib.rcParams) == before


def test_a_palette_keeps_the_colors_of_methods() -> None:
    figure = bars(*ROWS)
    everything = BytesIO()
    with style():
        figure.savefig(everything, format="png")
    small = png(figure)
    assert len(small) < 0.5 * len(everything.getvalue())
    drawn = imread(BytesIO(everything.getvalue()))[..., :3]
    np.testing.assert_allclose(imread(BytesIO(small))[..., :3], drawn, atol=0.07)


def test_only_visited_cells_are_colored() -> None:
    counts = np.array([[0, 3], [40, 0], [1, 0]])
    figure = coverage(counts, (-1.0, 1.0, 0.0, 3.0), "position", "m")
    axes = figure.axes[0]
    (image,) = axes.images
    shown = image.get_array()
    assert isinstance(shown, np.ma.MaskedArray)
    np.testing.assert_array_equal(shown.mask, counts == 0)
    assert image.origin == "lower" and (axes.get_xlim(), axes.get_ylim()) == ((-1.0, 1.0), (0.0, 3.0))
    assert axes.get_xlabel() == "x position (m)" and png(figure).startswith(b"\x89PNG")
