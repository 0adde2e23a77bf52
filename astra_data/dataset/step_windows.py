"""What training draws from episodes: windows of consecutive steps, and single transitions."""

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.dataset.samples import Batch, Samples, take

Padding = Literal["valid", "edge"]
IS_PAD = "is_pad"


class Transitions(Samples):
    """Single steps: column name to (B, size), or (B,) where there is one value per step."""

    def __init__(self, columns: Mapping[str, Tensor], rows: Tensor, device: torch.device) -> None:
        """Draw the rows `rows` (M,) of `columns` (N, ...)."""
        super().__init__(rows, device)
        self._columns = columns

    def _gather(self, first: Tensor) -> Batch:
        return {name: take(values, first) for name, values in self._columns.items()}


class Windows(Samples):
    """Windows of L steps: column name to (B, L, ...), and "is_pad" (B, L), true beyond the episode's ends."""

    def __init__(
        self,
        columns: Mapping[str, Tensor],
        starts: Tensor,
        lengths: Tensor,
        device: torch.device,
        *,
        length: int,
        stride: int,
        padding: Padding,
        past: int,
    ) -> None:
        """Cut windows out of the episodes of `columns` (N, ...), which begin at rows `starts` (E,).

        The other arguments and errors are those of `Frames.windows`.
        """
        faults = [
            f"{name} {value}, expected at least 1"
            for name, value in (("length", length), ("stride", stride))
            if value < 1
        ]
        longest = int(lengths.max())
        if padding == "valid" and length > longest:
            faults.append(
                f"length {length}, expected at most the longest episode's {longest}, or padding 'edge'"
            )
        if padding == "valid" and past:
            faults.append(f"past {past}, expected 0 without padding 'edge'")
        if padding == "edge" and not 0 <= past < max(length, 1):
            faults.append(f"past {past}, expected 0 to {length - 1}")
        if padding not in ("valid", "edge"):
            faults.append(f"padding {padding!r}, expected 'valid' or 'edge'")
        if faults:
            raise BadInputError(f"Windows: {'; '.join(faults)}.")
        anchors = lengths if padding == "edge" else (lengths - length + 1).clamp_min(0)
        super().__init__(_every(stride, starts - past, anchors), device)
        self._columns = columns
        self._starts, self._ends = starts, starts + lengths
        self._length, self._past = length, past
        self._rolled = {}
        if padding == "valid":
            self._rolled = {name: _rolled(values, length) for name, values in columns.items()}
        self._steps = torch.arange(length, device=starts.device)

    def _gather(self, first: Tensor) -> Batch:
        return self._inside(first) if self._rolled else self._padded(first)

    def _inside(self, first: Tensor) -> Batch:
        shape = (len(first), self._length)
        batch = {
            name: take(values, first).view(*shape, *self._columns[name].shape[1:])
            for name, values in self._rolled.items()
        }
        return batch | {IS_PAD: first.new_zeros(shape, dtype=torch.bool)}

    def _padded(self, first: Tensor) -> Batch:
        episode = torch.searchsorted(self._starts, first + self._past, right=True) - 1
        wanted = first[:, None] + self._steps
        rows = wanted.clamp(self._starts[episode, None], self._ends[episode, None] - 1)
        batch = {
            name: take(values, rows.view(-1)).view(*rows.shape, *values.shape[1:])
            for name, values in self._columns.items()
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
