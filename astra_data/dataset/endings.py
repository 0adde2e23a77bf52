"""How the episodes of a dataset end, and which of their next states were made up.

`terminal = "stand_still"` keeps a terminated last row of a log whose next state was not recorded, and lets
its state stand for it: that is no step of the robot.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from astra_data.dataset.columns import NEXT_STATE, REWARD, STATE, SUCCESS, TERMINATED, Array
from astra_data.dataset.reader import Dataset

NEEDED = (STATE, NEXT_STATE, TERMINATED)
"""Columns that show how an episode ends."""


@dataclass
class Endings:
    """How many episodes end in which way.

    Attributes:
        terminated: those that end in success or failure. cut_off: the others.
        made_up: those whose last next state is the state itself, to the bit, where they are terminated.
    """

    terminated: int = 0
    cut_off: int = 0
    made_up: int = 0

    def add(self, columns: Mapping[str, Array]) -> None:
        """Count an episode with these columns, of which `NEEDED` are looked at."""
        ended = is_terminated(columns)
        self.terminated += ended
        self.cut_off += not ended
        if STATE in columns and NEXT_STATE in columns:
            self.made_up += ended and stands_still(columns[STATE][-1], columns[NEXT_STATE][-1])

    def __str__(self) -> str:
        """Summarize them in a line."""
        return f"{self.terminated} terminated, {self.cut_off} cut off" + (
            f"; {self.made_up} next states of terminated episodes were made up: the state itself is used"
            if self.made_up
            else ""
        )


def endings_of(dataset: Dataset) -> Endings:
    """Return how the episodes of `dataset` end, reading one at a time.

    Raises:
        CorruptDatasetError: a file cannot be read.
    """
    found = Endings()
    for episode in dataset.episodes([name for name in NEEDED if name in dataset.features]):
        found.add(episode.columns)
    return found


def is_terminated(columns: Mapping[str, Array]) -> bool:
    """Return whether an episode with these columns is known to end in success or failure."""
    return TERMINATED in columns and bool(columns[TERMINATED][-1])


def outcome_of(columns: Mapping[str, Array]) -> dict[str, bool | float]:
    """Return what the metadata of an episode with these columns say of its outcome."""
    success = bool(columns[SUCCESS].any())
    return {
        "success": success,
        "failed": is_terminated(columns) and not success,
        "return": float(columns[REWARD].sum(dtype=np.float64)),
    }


def stands_still(state: Array, next_state: Array) -> bool:
    """Return whether a next state is the state, to the bit."""
    return bool((state == next_state).all())
