"""Types of numpy arrays, by what they hold."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
if TYPE_CHECKING:
    from torch import Tensor


def normalized(state: "Tensor", mean: "Tensor | float", std: "Tensor | float") -> "Tensor":
    """Return states (..., S) in standard deviations from the data's mean, clipped to ±5: networks extrapolate there."""
    return ((state - mean) / std).clamp(-5.0, 5.0)


def as_rows[Values: np.ndarray[Any, Any]](values: Values) -> Values:
    """Return a column of a dataset (T,) or (T, size) as rows, (T, size)."""
    return values.reshape(len(values), -1)  # type: ignore[return-value]


def as_column[Values: np.ndarray[Any, Any]](rows: Values) -> Values:
    """Return rows (T, ...) as a column of a dataset: (T,) where there is one value per step."""
    return rows[:, 0] if rows.ndim == 2 and rows.shape[1] == 1 else rows  # type: ignore[return-value]
