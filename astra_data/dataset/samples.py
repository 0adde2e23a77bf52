"""Samples that training draws in batches, in an order that can be left and resumed."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils import data

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import generator

Batch = dict[str, Tensor]
"""Column name to (B, ...)."""


class Samples(data.Dataset[Batch]):
    """Samples of the same shape, drawn one by one or in batches.

    For `torch.utils.data.DataLoader` pass `collate_fn=Samples.collate`, because whole batches are drawn at
    once; `batches` is faster.
    """

    def __init__(self, first: Tensor, gather: Callable[[Tensor], Batch], device: torch.device) -> None:
        """Hold samples that begin at rows `first` (M,); `gather` reads those at rows (B,), for `device`."""
        self._first = first
        self._gather = gather
        self._device = device

    def __len__(self) -> int:
        """Return the number of samples M."""
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

    @staticmethod
    def collate(batch: Any) -> Any:  # noqa: ANN401 - DataLoader expects a list
        """Return `batch` unchanged: it is collated already."""
        return batch

    def batches(
        self, batch_size: int, *, seed: int = 0, shuffle: bool = True, drop_last: bool = False
    ) -> "Batches":
        """Draw batches; the arguments are those of `Order`."""
        return Batches(self, Order(len(self), batch_size, seed=seed, shuffle=shuffle, drop_last=drop_last))


class Order:
    """Indices of `count` samples, batch by batch, reshuffled each epoch.

    An epoch's order depends on (seed, epoch) alone. Iterating yields the batches (B,) that are left of the
    current epoch; the next iteration continues from there. An `Order` also serves a `DataLoader` as
    batch_sampler; its workers draw a few batches ahead.

    Attributes:
        epoch: the epoch of the next batch.
        batch: its number in that epoch.
    """

    def __init__(
        self, count: int, batch_size: int, *, seed: int = 0, shuffle: bool = True, drop_last: bool = False
    ) -> None:
        """Start with the first batch of epoch 0.

        Args:
            count: number of samples.
            batch_size: B.
            seed: of all epochs.
            shuffle: False to keep the samples' order.
            drop_last: leave out an epoch's last batch if it is smaller than the others.

        Raises:
            BadInputError: there would be no batches.
        """
        whole, rest = divmod(count, max(batch_size, 1))
        self._batches = whole + (rest > 0 and not drop_last)
        if batch_size < 1 or self._batches < 1:
            raise BadInputError(f"batches of {batch_size} out of {count} samples: expected 1 to {count}")
        self._settings = {
            "count": count,
            "batch_size": batch_size,
            "seed": seed,
            "shuffle": shuffle,
            "drop_last": drop_last,
        }
        self.epoch = 0
        self.batch = 0

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return self._batches

    def __iter__(self) -> Iterator[Tensor]:
        """Yield the batches (B,) that are left of this epoch."""
        epoch, count, size = self.epoch, self._settings["count"], self._settings["batch_size"]
        order = torch.arange(count)
        if self._settings["shuffle"]:
            numbers = generator(self._settings["seed"], f"order of epoch {epoch}")
            order = torch.from_numpy(numbers.permutation(count))
        for batch in range(self.batch, len(self)):
            # Set before yielding, so that a state saved inside the loop names the next batch.
            self.epoch, self.batch = (epoch, batch + 1) if batch + 1 < len(self) else (epoch + 1, 0)
            yield order[batch * size : (batch + 1) * size]

    def state_dict(self) -> dict[str, Any]:
        """Return the settings and the next batch: plain numbers, for `load_state_dict`."""
        return {**self._settings, "epoch": self.epoch, "batch": self.batch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state`.

        Raises:
            BadInputError: it belongs to another order, or names a batch that does not exist; lists every
                fault.
        """
        faults = [
            f"{key} is {state.get(key)!r}, expected {value!r}"
            for key, value in self._settings.items()
            if state.get(key) != value
        ]
        ranges = {"epoch": (math.inf, "0 or more"), "batch": (len(self), f"0 to {len(self) - 1}")}
        faults += [
            f"{key} is {state.get(key)!r}, expected {expected}"
            for key, (end, expected) in ranges.items()
            if type(state.get(key)) is not int or not 0 <= state[key] < end
        ]
        if faults:
            raise BadInputError(f"the state is of another order of samples: {'; '.join(faults)}")
        self.epoch, self.batch = state["epoch"], state["batch"]


class Batches:
    """Batches of `samples` in `order`, one epoch per iteration."""

    def __init__(self, samples: Samples, order: Order) -> None:
        self.samples = samples
        self.order = order
        self.state_dict = order.state_dict
        self.load_state_dict = order.load_state_dict

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return len(self.order)

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches that are left of this epoch."""
        return map(self.samples.__getitems__, self.order)


def take(values: Tensor, rows: Tensor) -> Tensor:
    """Return the rows `rows` (n,) of `values` (N, ...)."""
    if values.device.type != "cpu" or not values.is_contiguous():
        return values.index_select(0, rows)
    # For many short rows numpy is faster; of an array that is not contiguous it would first copy all.
    return torch.from_numpy(values.numpy().take(rows.numpy(), axis=0))
