"""The range of the commands that were recorded, and how often a policy asks for others."""

from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor

from astra_data.core.errors import AstraDataError
from astra_data.dataset.columns import ACTION
from astra_data.dataset.reader import Dataset
from astra_data.worlds.commands import Commands

TOLERANCE = 0.01
"""Share of the recorded range by which a command may be beyond it."""


class RecordedRange:
    """Counts the steps in which any of A commands lies beyond what was recorded."""

    def __init__(self, least: Tensor, largest: Tensor, limits: Commands) -> None:
        """Take the range `least` to `largest`, both (A,), in the units of `limits`."""
        margin = TOLERANCE * (largest - least)
        self._least, self._largest, self._limits = least - margin, largest + margin, limits
        self._steps = self._beyond = 0

    @classmethod
    def of(cls, dataset: Path, limits: Commands) -> Self | None:
        """Return the range in a dataset; None if it cannot be read any more."""
        try:
            statistics = Dataset.open(dataset).statistics()
        except AstraDataError:
            return None
        if isinstance(statistics, str):
            return None
        least, largest = (
            torch.from_numpy(np.asarray(statistics[ACTION][end], np.float32)) for end in ("min", "max")
        )
        return cls(least, largest, limits)

    def count(self, action: Tensor, active: Tensor) -> None:
        """Count a step with actions of ±1 (B, A), of the robots in `active` (B,)."""
        command = self._limits.in_units(action)
        beyond = ((command < self._least) | (command > self._largest)).any(dim=-1)
        self._steps += int(active.sum())
        self._beyond += int((beyond & active).sum())

    @property
    def share(self) -> float:
        """The share of the steps so far that were beyond."""
        return self._beyond / self._steps
