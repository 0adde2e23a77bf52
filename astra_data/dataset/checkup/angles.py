"""Angles that are too large for their unit: degrees that were taken for radians."""

import math
import re

import numpy as np
from numpy.typing import NDArray

from astra_data.core.numbers import as_rows
from astra_data.dataset.checkup.finding import Finding, channels
from astra_data.dataset.columns import Column, Episode

ANGLE = re.compile(r"(.+_)?(heading|yaw|theta|psi|roll|pitch|angle|q\d*|joint\d*)")
"""Names of angles."""
TURNS = {"rad": 2 * math.pi, "deg": 360.0}
"""What a full turn is in each unit."""
LARGEST = 4 * math.pi
"""Few robots turn further than twice around."""


def is_angle(name: str) -> bool:
    """Return whether `name` is one of an angle, as "base.theta" or "Yaw.pos"."""
    short = re.sub(r"[^a-z0-9]+", "_", name.lower())
    return ANGLE.fullmatch(re.sub(r"_(pos|position|rad|deg)$", "", short)) is not None


class Angles:
    """The values in radians of a column."""

    def __init__(self, column: Column) -> None:
        self._column = column
        self._angles = [index for index, unit in enumerate(column.units) if unit == "rad"]
        self._farthest: NDArray[np.float64] = np.zeros(len(self._angles))

    def add(self, episode: Episode) -> None:
        """Look at the next episode."""
        values = as_rows(episode.columns[self._column.name])[:, self._angles]
        self._farthest = np.maximum(self._farthest, np.abs(values).max(axis=0))

    def findings(self) -> list[Finding]:
        """Tell which angles are larger than `LARGEST`."""
        found = np.flatnonzero(self._farthest > LARGEST).tolist()
        if not found:
            return []
        named = channels(self._column, [self._angles[index] for index in found])
        what = f"{named}: up to {self._farthest[found].max():.4g} rad, which is more than two full turns"
        advice = "if these are degrees, set `scale` to 0.0174533 in the mapping and import again"
        return [Finding("warning", what, advice)]
