"""Means and deviations of a network's inputs and outputs, in buffers `<name>_mean` and `<name>_std`."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

_LEAST = 1e-3
"""Lower bound of a deviation."""


def add_scales(network: nn.Module, sizes: Mapping[str, int]) -> None:
    """Give `network` buffers (size,) for each name, as of values that are normal already."""
    for name, size in sizes.items():
        network.register_buffer(f"{name}_mean", torch.zeros(size))
        network.register_buffer(f"{name}_std", torch.ones(size))


def take_scales(network: nn.Module, values: Mapping[str, Tensor]) -> None:
    """Take means and deviations from the values (N, size) of each name; those of size 0 have none."""
    for name, seen in values.items():
        if seen.numel():
            getattr(network, f"{name}_mean").copy_(seen.mean(0))
            getattr(network, f"{name}_std").copy_(seen.std(0).clamp_min(_LEAST))
