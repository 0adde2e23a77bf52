"""Types of numpy arrays, by what they hold."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.lazy import Tensor

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def normalized(state: Tensor, mean: Tensor | float, std: Tensor | float) -> Tensor:
    """Return states (..., S) in standard deviations from the data's mean, clipped to ±5: networks extrapolate there."""
    return ((state - mean) / std).clamp(-5.0, 5.0)


def gaussian_log_prob(mean: Tensor, std: Tensor, value: Tensor) -> Tensor:
    """Return the log-density (...) of `value` (..., A) under independent Gaussians (..., A)."""
    return (((value - mean) / std).square() / -2 - std.log() - math.log(2 * math.pi) / 2).sum(-1)


def as_rows[Values: np.ndarray[Any, Any]](values: Values) -> Values:
    """Return a column of a dataset (T,) or (T, size) as rows, (T, size)."""
    return values.reshape(len(values), -1)  # type: ignore[return-value]


def as_column[Values: np.ndarray[Any, Any]](rows: Values) -> Values:
    """Return rows (T, ...) as a column of a dataset: (T,) where there is one value per step."""
    return rows[:, 0] if rows.ndim == 2 and rows.shape[1] == 1 else rows  # type: ignore[return-value]
