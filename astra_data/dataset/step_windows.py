"""Windows of L consecutive steps of one episode."""

from collections.abc import Mapping
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.dataset.samples import Batch, Samples, take

Padding = Literal["valid", "edge"]
IS_PAD = "is_pad"


def step_windows(
    columns: Mapping[str, Tensor],
    starts: Tensor,
    lengths: Tensor,
    device: torch.device,
    *,
    length: int,
    stride: int,
    padding: Padding,
    past: int,
) -> Samples:
    """Cut windows from the episodes of `columns` (N, ...), which begin at rows `starts` (E,).

    Samples are column name to (L, ...), and "is_pad" (L,), true outside of the episode. The other arguments
    and errors are those of `Frames.windows`.
    """
    faults = [
        f"{name} {value}, expected at least 1"
        for name, value in (("length", length), ("stride", stride))
        if value < 1
    ]
    longest = int(lengths.max())
    if padding == "valid" and length > longest:
        faults.append(f"length {length}, expected at most the longest episode's {longest}, or padding 'edge'")
    if padding == "valid" and past:
        faults.append(f"past {past}, expected 0 without padding 'edge'")
    if padding == "edge" and not 0 <= past < max(length, 1):
        faults.append(f"past {past}, expected 0 to {length - 1}")
    if padding not in ("valid", "edge"):
        faults.append(f"padding {padding!r}, expected 'valid' or 'edge'")
    if faults:
        raise BadInputError(f"Windows: {'; '.join(faults)}.")
    if padding == "edge":
        gather = partial(_padded, columns, starts, starts + lengths, past, length)
        return Samples(_every(stride, starts - past, lengths), gather, device)
    rolled = {name: _rolled(values, length) for name, values in columns.items()}
    first = _every(stride, starts, (lengths - length + 1).clamp_min(0))
    return Samples(first, partial(_inside, columns, rolled, length), device)


def _inside(columns: Mapping[str, Tensor], rolled: Mapping[str, Tensor], length: int, first: Tensor) -> Batch:
    shape = (len(first), length)
    batch = {
        name: take(values, first).view(*shape, *columns[name].shape[1:]) for name, values in rolled.items()
    }
    return batch | {IS_PAD: first.new_zeros(shape, dtype=torch.bool)}


def _padded(
    columns: Mapping[str, Tensor], starts: Tensor, ends: Tensor, past: int, length: int, first: Tensor
) -> Batch:
    episode = torch.searchsorted(starts, first + past, right=True) - 1
    wanted = first[:, None] + torch.arange(length, device=first.device)
    rows = wanted.clamp(starts[episode, None], ends[episode, None] - 1)
    batch = {
        name: take(values, rows.view(-1)).view(*rows.shape, *values.shape[1:])
        for name, values in columns.items()
    }
    return batch | {IS_PAD: rows != wanted}


def _every(stride: int, begins: Tensor, counts: Tensor) -> Tensor:
    """Return every `stride`-th of the `counts` (E,) rows from each of `begins` (E,) on."""
    counts = (counts + stride - 1).div(stride, rounding_mode="floor")
    number = torch.arange(int(counts.sum()), device=begins.device)
    number -= (counts.cumsum(0) - counts).repeat_interleave(counts)
    return number.mul_(stride).add_(begins.repeat_interleave(counts))


def _rolled(values: Tensor, length: int) -> Tensor:
    """View `values` (N, ...) so that row i holds steps i to i + L - 1, side by side as in memory."""
    size = values[0].numel()
    return values.as_strided((len(values) - length + 1, length * size), (size, 1))
