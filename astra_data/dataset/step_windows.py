"""Windows of L consecutive steps of one episode, gathered from the rows at which they begin."""

from collections.abc import Mapping

import torch
from torch import Tensor

from astra_data.dataset.samples import Batch, take

IS_PAD = "is_pad"


def inside(columns: Mapping[str, Tensor], views: Mapping[str, Tensor], length: int, first: Tensor) -> Batch:
    """Return the windows at rows `first` (B,), all inside their episode, from `rolled` views of `columns`."""
    shape = (len(first), length)
    batch = {
        name: take(values, first).view(*shape, *columns[name].shape[1:]) for name, values in views.items()
    }
    return batch | {IS_PAD: first.new_zeros(shape, dtype=torch.bool)}


def padded(
    columns: Mapping[str, Tensor], starts: Tensor, ends: Tensor, past: int, length: int, first: Tensor
) -> Batch:
    """Return the windows at rows `first` (B,), which may lie outside; step `past` is in the episode.

    Episodes are the rows from `starts` (E,) to `ends` (E,).
    """
    episode = torch.searchsorted(starts, first + past, right=True) - 1
    wanted = first[:, None] + torch.arange(length, device=first.device)
    rows = wanted.clamp(starts[episode, None], ends[episode, None] - 1)
    batch = {
        name: take(values, rows.view(-1)).view(*rows.shape, *values.shape[1:])
        for name, values in columns.items()
    }
    return batch | {IS_PAD: rows != wanted}


def every(stride: int, begins: Tensor, counts: Tensor) -> Tensor:
    """Return every `stride`-th of the `counts` (E,) rows from each of `begins` (E,) on."""
    counts = (counts + stride - 1).div(stride, rounding_mode="floor")
    number = torch.arange(int(counts.sum()), device=begins.device)
    number -= (counts.cumsum(0) - counts).repeat_interleave(counts)
    return number.mul_(stride).add_(begins.repeat_interleave(counts))


def rolled(values: Tensor, length: int) -> Tensor:
    """View `values` (N, ...) so that row i holds steps i to i + L - 1, side by side as in memory."""
    size = values[0].numel()
    return values.as_strided((len(values) - length + 1, length * size), (size, 1))
