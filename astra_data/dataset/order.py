"""The order in which samples are drawn, which can be left and taken up again."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import generator


class Order:
    """Indices of `count` samples, batch by batch, each epoch in an order of its own.

    An epoch's order follows from (seed, epoch) alone. Iterating yields the batches (B,) that are left of
    the current epoch; the next iteration goes on from there. It also serves a `DataLoader` as batch_sampler,
    whose workers draw a few batches ahead of those that were seen.

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
            seed: of all orders.
            shuffle: whether to shuffle at all.
            drop_last: leave out an epoch's last batch if it is smaller than the others.

        Raises:
            BadInputError: there would be no batches.
        """
        self._facts = {
            "count": count,
            "batch_size": batch_size,
            "seed": seed,
            "shuffle": shuffle,
            "drop_last": drop_last,
        }
        if batch_size < 1 or len(self) < 1:
            raise BadInputError(
                f"batches of {batch_size} out of {count} samples: expected 1 to {count}, so that there is one"
            )
        self.epoch = 0
        self.batch = 0

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        whole, rest = divmod(self._facts["count"], self._facts["batch_size"])
        return whole + (rest > 0 and not self._facts["drop_last"])

    def __iter__(self) -> Iterator[Tensor]:
        """Yield the batches (B,) that are left of this epoch."""
        epoch, size = self.epoch, self._facts["batch_size"]
        order = self._order()
        for batch in range(self.batch, len(self)):
            # Set before yielding, so that what is saved inside the loop names the next batch.
            self.epoch, self.batch = (epoch, batch + 1) if batch + 1 < len(self) else (epoch + 1, 0)
            yield order[batch * size : (batch + 1) * size]

    def _order(self) -> Tensor:
        count = self._facts["count"]
        if not self._facts["shuffle"]:
            return torch.arange(count)
        numbers = generator(self._facts["seed"], f"order of epoch {self.epoch}")
        return torch.from_numpy(numbers.permutation(count))

    def state_dict(self) -> dict[str, Any]:
        """Return what `load_state_dict` takes: plain numbers."""
        return {**self._facts, "epoch": self.epoch, "batch": self.batch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken.

        Raises:
            BadInputError: it is of another order, or names a batch that there is not; lists every fault.
        """
        faults = [
            f"{key} is {state.get(key)!r}, expected {value!r}"
            for key, value in self._facts.items()
            if state.get(key) != value
        ]
        places = {"epoch": (math.inf, "0 or more"), "batch": (len(self), f"0 to {len(self) - 1}")}
        faults += [
            f"{key} is {state.get(key)!r}, expected {expected}"
            for key, (end, expected) in places.items()
            if type(state.get(key)) is not int or not 0 <= state[key] < end
        ]
        if faults:
            raise BadInputError(f"the state is of another order of samples: {'; '.join(faults)}")
        self.epoch, self.batch = state["epoch"], state["batch"]
