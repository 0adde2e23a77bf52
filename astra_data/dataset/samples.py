"""Samples of a dataset that training draws in batches."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils import data

from astra_data.dataset.order import Order

Batch = dict[str, Tensor]
"""Column name to (B, ...)."""


class Samples(data.Dataset[Batch], ABC):
    """Samples of the same shape, drawn one by one or in batches.

    For `torch.utils.data.DataLoader` give `collate_fn=Samples.collate`, because whole batches are drawn at
    once; `batches` is faster.
    """

    def __init__(self, first: Tensor, device: torch.device) -> None:
        """Draw samples that begin at rows `first` (M,) of the columns, to `device`."""
        self._first = first
        self._device = device

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._first)

    def __getitem__(self, index: int) -> Batch:
        """Return one sample, without the batch dimension."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        return {name: values[0] for name, values in self.__getitems__([index % len(self)]).items()}

    def __getitems__(self, index: Sequence[int] | Tensor) -> Batch:
        """Return the samples `index` (B,) as one batch, column name to (B, ...)."""
        first = take(self._first, torch.as_tensor(index, device=self._first.device))
        return {name: values.to(self._device) for name, values in self._gather(first).items()}

    @abstractmethod
    def _gather(self, first: Tensor) -> Batch:
        """Return the samples that begin at rows `first` (B,)."""

    @staticmethod
    def collate(batch: Any) -> Any:  # noqa: ANN401 - DataLoader expects a list
        """Return `batch`, which is one already."""
        return batch

    def batches(
        self, batch_size: int, *, seed: int = 0, shuffle: bool = True, drop_last: bool = False
    ) -> "Batches":
        """Draw batches; the arguments are those of `Order`."""
        return Batches(self, Order(len(self), batch_size, seed=seed, shuffle=shuffle, drop_last=drop_last))


class Batches:
    """Batches of samples, one epoch per iteration; see `Order`.

    Attributes:
        samples: what is drawn from.
        order: what is drawn next.
    """

    def __init__(self, samples: Samples, order: Order) -> None:
        """Draw from `samples` in `order`."""
        self.samples = samples
        self.order = order

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return len(self.order)

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches that are left of this epoch."""
        for index in self.order:
            yield self.samples.__getitems__(index)

    def state_dict(self) -> dict[str, Any]:
        """Return where the order is."""
        return self.order.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken.

        Raises:
            BadInputError: it is of another order.
        """
        self.order.load_state_dict(state)


def take(values: Tensor, rows: Tensor) -> Tensor:
    """Return the rows `rows` (n,) of `values` (N, ...)."""
    if values.is_cuda or not values.is_contiguous():
        return values.index_select(0, rows)
    # For many short rows numpy is faster; of an array that is not contiguous it would first copy all.
    return torch.from_numpy(values.numpy().take(rows.numpy(), axis=0))
