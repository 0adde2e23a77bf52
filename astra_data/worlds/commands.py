"""Commands in their own units, and as policies give them: ±1 along each axis."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION
from astra_data.dataset.versions import open_dataset


class Commands(Mapping[str, tuple[float, float]]):
    """The least and the largest command along each of A axes, by the axes' names.

    Example:
        >>> import torch
        >>> from astra_data.worlds.commands import Commands
        >>> drive = Commands({"v": (-0.2, 1.0), "w": (-1.5, 1.5)})
        >>> drive.in_units(torch.tensor([[1.0, 0.0]]))
        tensor([[1., 0.]])
        >>> drive.normal(torch.tensor([[0.4, 1.5]]))
        tensor([[0., 1.]])
    """

    def __init__(self, bounds: Mapping[str, tuple[float, float]]) -> None:
        """Take the bounds (least, largest) of each axis, in the units of the robot's commands.

        Raises:
            BadInputError: there is none, or an axis has no two finite ends in order; lists every fault.
        """
        faults = [] if bounds else ["no axis is named"]
        for name, ends in bounds.items():
            if np.shape(ends) != (2,) or not np.isfinite(ends).all() or not ends[0] < ends[1]:
                faults.append(f"{name}: expected (least, largest), got {ends!r}")
        if faults:
            raise BadInputError(f"commands: {'; '.join(faults)}")
        self._bounds = {name: (float(low), float(high)) for name, (low, high) in bounds.items()}
        low, high = torch.tensor(list(self._bounds.values())).unbind(-1)
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self.are_normal = all(ends == (-1.0, 1.0) for ends in self._bounds.values())
        """Whether they are ±1 in their own units already."""

    @classmethod
    def recorded(cls, dataset: str | Path) -> Self:
        """Return the range of the commands in a dataset, named as every command takes it, as the bounds.

        Raises:
            BadInputError: there is no such dataset, it has no commands, or one of them never changes.
            CorruptDatasetError: it is incomplete or was altered.
        """
        source = open_dataset(dataset)
        statistics = source.statistics()
        if isinstance(statistics, str):
            raise BadInputError(f"commands: the range of {source.reference} is not known: {statistics}")
        if ACTION not in statistics:
            raise BadInputError(f"commands: {source.reference} has no column {ACTION}: give their bounds")
        least, largest = (np.asarray(statistics[ACTION][end], float).tolist() for end in ("min", "max"))
        column = next(column for column in source.schema if column.name == ACTION)
        names = column.labels
        if still := [name for name, low, high in zip(names, least, largest, strict=True) if low == high]:
            raise BadInputError(
                f"commands: {', '.join(still)} never changes in {source.reference}: give the bounds"
            )
        return cls(dict(zip(names, zip(least, largest, strict=True), strict=True)))

    def __getitem__(self, name: str) -> tuple[float, float]:
        """Return the bounds of an axis."""
        return self._bounds[name]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the axes."""
        return iter(self._bounds)

    def __len__(self) -> int:
        """Return the number of axes, A."""
        return len(self._bounds)

    def in_units(self, action: Tensor) -> Tensor:
        """Return actions of ±1 (..., A), clipped to that first, in the units of the commands."""
        clipped = action.clamp(-1.0, 1.0)
        if self.are_normal:
            return clipped
        return self._middle.to(action.device) + self._half.to(action.device) * clipped

    def normal(self, command: Tensor) -> Tensor:
        """Return commands (..., A) as multiples of ±1; those beyond the bounds are beyond ±1."""
        if self.are_normal:
            return command
        return (command - self._middle.to(command.device)) / self._half.to(command.device)
