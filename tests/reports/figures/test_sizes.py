import numpy as np

from astra_data.dataset.inspection import Map
from astra_data.reports.figures.sizes import Scored, data_efficiency
from astra_data.reports.figures.style import png
from astra_data.worlds.score import SUCCESS, SURVIVED_STEPS


def test_data_efficiency_has_a_map_per_size_and_a_band_per_row() -> None:
    visits = [Map(np.full((2, 3), count), np.zeros(2), 1.0) for count in (4, 1, 9)]
    nas = {
        100: Scored(np.array([0.6, 0.8]), 0.7, 0.6, 0.8),
        # This size has a seed less than the others.
        25: Scored(np.array([0.2]), 0.1, 0.0, 0.3),
        150: Scored(np.array([0.7, 0.9]), 0.8, 0.7, 0.9),
    }
    figure = data_efficiency(SUCCESS, [100, 25, 150], {"nas": nas}, {"position (m)": visits})
    *maps, success = figure.axes
    # Sizes are in order, however they are given.
    assert [axes.get_title() for axes in maps] == ["25 %", "100 %", "150 %"]
    assert [axes.images[0].get_array().max() for axes in maps] == [1, 4, 9]  # type: ignore[union-attr]
    line = success.lines[0]
    assert np.array(line.get_xdata()).tolist() == [25, 100, 150]
    assert np.array(line.get_ydata()).tolist() == [0.1, 0.7, 0.8]
    assert len(success.collections) == 1
    band = success.collections[0].get_paths()[0].vertices
    assert {(x, y) for x, y in np.asarray(band).tolist()} == {
        *((25, 0.0), (25, 0.3), (100, 0.6), (100, 0.8), (150, 0.7), (150, 0.9)),
    }
    assert success.get_ylim() == (-0.02, 1.02) and success.get_ylabel() == "success rate in the target"
    assert png(figure)


def test_a_row_is_drawn_at_the_sizes_that_it_has() -> None:
    rows = {
        "nas": {
            150: Scored(np.array([0.9]), 0.9, np.nan, np.nan),
            25: Scored(np.array([0.2]), 0.2, 0.1, 0.3),
        },
        "astra": {100: Scored(np.array([0.5, 0.7]), 0.6, 0.5, 0.7)},
    }
    axes = data_efficiency(SURVIVED_STEPS, [25, 100, 150], rows, {}, "in a simulator").axes[0]
    lines = [np.asarray(line.get_xydata()).tolist() for line in axes.lines]
    assert lines == [
        *([[25, 0.2], [150, 0.9]], [[25, 0.2], [150, 0.9]]),
        *([[100, 0.6]], [[100, 0.5], [100, 0.7]]),
    ]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["25 %", "100 %", "150 %"]
    # A seed alone has no interval, so the first row has no band.
    assert len(axes.collections) == 1
    assert axes.get_ylim()[0] == 0.0
    assert axes.get_ylabel() == "number of survived steps in a simulator"
