"""Numbers as networks see them."""

from torch import Tensor


def normalised(state: Tensor, mean: Tensor | float, std: Tensor | float) -> Tensor:
    """Return states (..., S) in deviations from the data's mean, cut off at ±5.

    What is farther away was hardly seen: a network that is shown more of it answers with anything, and a
    simulator that it corrects flies away.
    """
    return ((state - mean) / std).clamp(-5.0, 5.0)
