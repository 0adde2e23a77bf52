"""Errors by horizon, averaged over seeds."""

from collections.abc import Sequence

import numpy as np

from astra_data.reports.artifacts import Band
from astra_data.reports.schema import BandMeans


def mean_band(
    bands: Sequence[Band | BandMeans],
    places: Sequence[Sequence[int]],
    weights: Sequence[int] | None = None,
) -> BandMeans:
    """Return the mean of bands, each at the `places` of its horizons, and weighed alike without `weights`."""
    ends = np.average(
        [
            np.array([band.mean, band.low, band.high], dtype=float)[:, kept]
            for band, kept in zip(bands, places, strict=True)
        ],
        axis=0,
        weights=weights,
    )
    low, high = ([None if np.isnan(end) else end for end in of.tolist()] for of in ends[1:])
    return BandMeans(mean=ends[0].tolist(), low=low, high=high)
