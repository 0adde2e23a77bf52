import numpy as np

from astra_data.reports.figures.sizes import Visits, data_efficiency
from astra_data.reports.figures.style import png
from astra_data.worlds.score import SUCCESS, SURVIVED_STEPS


def test_data_efficiency_has_a_map_per_size_and_a_band_per_row() -> None:
    visits = [Visits(np.full((2, 3), count), (0.0, 3.0, 0.0, 2.0)) for count in (4, 1, 9)]
    # One size has a seed less than the others.
    scores = {"nas": [np.array([0.6, 0.8]), np.array([0.2]), np.array([0.7, 0.9])]}
    intervals = {"nas": np.array([[0.7, 0.1, 0.8], [0.6, 0.0, 0.7], [0.8, 0.3, 0.9]])}
    figure = data_efficiency(SUCCESS, [100, 25, 150], scores, intervals, {"position (m)": visits})
    *maps, success = figure.axes
    # Sizes are in order, however they are given.
    assert [axes.get_title() for axes in maps] == ["25 %", "100 %", "150 %"]
    assert [axes.images[0].get_array().max() for axes in maps] == [1, 4, 9]  # type: ignore[union-attr]
    line = success.lines[0]
    assert np.array(line.get_xdata()).tolist() == [25, 100, 150]
    assert np.array(line.get_ydata()).tolist() == [0.1, 0.7, 0.8]
    assert len(success.collections) == 1
    alone = {"nas": np.full((3, 3), np.nan)}
    assert not data_efficiency(SUCCESS, [100, 25, 150], scores, alone, {}).axes[0].collections
    other = data_efficiency(SURVIVED_STEPS, [100, 25, 150], scores, alone, {}).axes[0]
    assert (success.get_ylim(), other.get_ylim()[0]) == ((-0.02, 1.02), 0.0)
    assert success.get_ylabel() == "success rate in the target" != other.get_ylabel()
    judged = data_efficiency(SUCCESS, [100, 25, 150], scores, alone, {}, "in a simulator").axes[0]
    assert judged.get_ylabel() == "success rate in a simulator"
    assert png(figure)
