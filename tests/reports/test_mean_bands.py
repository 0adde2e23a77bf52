import pytest

from astra_data.reports.artifacts import Band
from astra_data.reports.mean_bands import mean_band


def test_bands_are_averaged_where_their_horizons_are() -> None:
    long = Band(mean=[1.0, 5.0, 2.0], low=[0.5, 4.0, 1.0], high=[2.0, 6.0, None])
    short = Band(mean=[3.0, 6.0], low=[2.5, 5.0], high=[4.0, 8.0])
    mean = mean_band([long, short], [[0, 2], [0, 1]])
    assert (mean.mean, mean.low, mean.high) == ([2.0, 4.0], [1.5, 3.0], [3.0, None])
    weighed = mean_band([long, short], [[0, 2], [0, 1]], [3, 1])
    assert weighed.mean == pytest.approx([1.5, 3.0]) and weighed.high == [2.5, None]
