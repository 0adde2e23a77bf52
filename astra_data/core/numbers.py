"""Normalisation of network inputs."""

from torch import Tensor


def normalised(state: Tensor, mean: Tensor | float, std: Tensor | float) -> Tensor:
    """Return states (..., S) in standard deviations from the data's mean, clipped to ±5.

    The data hold hardly anything beyond: a network extrapolates there, and a simulator that it corrects
    diverges.
    """
    return ((state - mean) / std).clamp(-5.0, 5.0)
