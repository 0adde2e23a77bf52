import numpy as np

from astra_data.reports.figures.coverage import coverage
from astra_data.reports.figures.style import png


def test_only_visited_cells_are_colored() -> None:
    counts = np.array([[0, 3], [40, 0], [1, 0]])
    figure = coverage(counts, (-1.0, 1.0, 0.0, 3.0), "position", "m")
    axes = figure.axes[0]
    (image,) = axes.images
    shown = image.get_array()
    assert isinstance(shown, np.ma.MaskedArray)
    np.testing.assert_array_equal(shown.mask, counts == 0)
    assert image.origin == "lower"
    assert (axes.get_xlim(), axes.get_ylim()) == ((-1.0, 1.0), (0.0, 3.0))
    assert axes.get_xlabel() == "x position (m)"
    assert png(figure).startswith(b"\x89PNG")
