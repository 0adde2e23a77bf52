"""Columns of chosen episodes as tensors, from which training draws windows and transitions."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.core.provenance import memory_bytes
from astra_data.dataset.column_files import cache_folder, mapped_columns
from astra_data.dataset.reader import Dataset
from astra_data.dataset.samples import Samples, take
from astra_data.dataset.step_windows import every, inside, padded, rolled

Padding = Literal["valid", "edge"]
MEMORY_SHARE = 0.5
"""Columns that take more than this share of the machine's memory are memory-mapped."""


@dataclass(frozen=True, eq=False, repr=False)
class Frames:
    """The steps of E episodes.

        frames = Frames.load(dataset, [STATE, ACTION], episodes=dataset.subset(100))
        for batch in frames.windows(32).batches(256, seed=0):
            batch["observation.state"]  # (256, 32, 29)

    Attributes:
        columns: name to (N, size), or (N,) where there is one value per step.
        starts: first row of each episode, (E,), ascending.
        lengths: its number of steps, (E,).
        device: of the batches.

    Example:
        >>> from astra_data import Dataset, Frames
        >>> frames = Frames.load(Dataset.open("walks"), ["action"])
        >>> batch = next(iter(frames.windows(8, padding="edge").batches(4, seed=0)))
        >>> batch["action"].shape  # (B, T, A)
        torch.Size([4, 8, 2])
    """

    columns: dict[str, Tensor]
    starts: Tensor
    lengths: Tensor
    device: torch.device

    @classmethod
    def load(
        cls,
        dataset: Dataset,
        names: Sequence[str] | None = None,
        *,
        episodes: Collection[int] | None = None,
        device: str = "cpu",
        memory_share: float = MEMORY_SHARE,
        cache: Path | None = None,
    ) -> "Frames":
        """Load whole columns.

        Columns of more than `memory_share` of the machine's memory are memory-mapped from raw files instead.
        Columns that do not fit on a CUDA device stay in main memory, and each batch is moved to the device.

        Args:
            dataset: the dataset.
            names: names of the columns, by default all of `dataset.schema`.
            episodes: indices of the episodes, by default all; they come in the dataset's order.
            device: torch device of the batches.
            memory_share: 0 to memory-map always.
            cache: folder of the raw files, by default `column_files.cache_folder()`.

        Raises:
            BadInputError: a column or an episode does not exist, or an episode is listed twice.
            CorruptDatasetError: a file cannot be read.
        """
        names = [column.name for column in dataset.schema] if names is None else names
        chosen = dataset.selected(episodes)
        lengths = dataset.lengths[chosen]
        step_bytes = sum(column.size * np.dtype(column.dtype).itemsize for column in dataset.specs(names))
        if step_bytes * int(lengths.sum()) > memory_share * memory_bytes():
            arrays = mapped_columns(dataset, names, cache or cache_folder())
            starts = dataset.starts[chosen]
        else:
            arrays = dataset.columns(names, episodes)
            starts = np.cumsum(lengths) - lengths
        columns = {name: torch.from_numpy(values) for name, values in arrays.items()}
        target = torch.device(device)
        storage = target if _fits(columns, target) else torch.device("cpu")
        return cls(
            columns={name: values.to(storage) for name, values in columns.items()},
            starts=torch.from_numpy(starts).to(storage),
            lengths=torch.from_numpy(lengths).to(storage),
            device=target,
        )

    def __len__(self) -> int:
        """Return the number of steps of all episodes."""
        return int(self.lengths.sum())

    def __repr__(self) -> str:
        """Show sizes and columns."""
        columns = ", ".join(f"{name} {tuple(values.shape[1:])}" for name, values in self.columns.items())
        return f"Frames({len(self.lengths)} episodes, {len(self)} steps, {columns}, to {self.device})"

    def windows(self, length: int, *, stride: int = 1, padding: Padding = "valid", past: int = 0) -> Samples:
        """Return windows of L consecutive steps of one episode, with "is_pad" (L,), true outside of it.

        Args:
            length: L.
            stride: steps from one window to the next.
            padding: "valid" for windows inside their episode; "edge" for a window at every step t (of a
                stride), padded with the first or the last step, as in lerobot's `delta_timestamps`.
            past: with "edge", how many steps before t the window begins.

        Raises:
            BadInputError: an argument is out of range, or no episode is long enough; lists every fault.
        """
        longest = int(self.lengths.max())
        faults = [
            f"{name} {value}, expected at least 1"
            for name, value in (("length", length), ("stride", stride))
            if value < 1
        ]
        if padding == "valid" and length > longest:
            faults.append(
                f"length {length}, expected at most {longest}, the longest episode's, or padding 'edge'"
            )
        if padding == "valid" and past:
            faults.append(f"past {past}, expected 0 without padding 'edge'")
        if padding == "edge" and not 0 <= past < max(length, 1):
            faults.append(f"past {past}, expected 0 to {length - 1}")
        if padding not in ("valid", "edge"):
            faults.append(f"padding {padding!r}, expected 'valid' or 'edge'")
        if faults:
            raise BadInputError(f"Windows: {'; '.join(faults)}.")
        if padding == "edge":
            gather = partial(padded, self.columns, self.starts, self.starts + self.lengths, past, length)
            return Samples(every(stride, self.starts - past, self.lengths), gather, self.device)
        views = {name: rolled(values, length) for name, values in self.columns.items()}
        first = every(stride, self.starts, (self.lengths - length + 1).clamp_min(0))
        return Samples(first, partial(inside, self.columns, views, length), self.device)

    def transitions(self) -> Samples:
        """Return single steps; the step's outcome is in its columns `next.*`."""
        steps = torch.arange(len(self), device=self.starts.device)
        before = self.lengths.cumsum(0) - self.lengths
        rows = steps + (self.starts - before).repeat_interleave(self.lengths)
        return Samples(rows, partial(_rows, self.columns), self.device)


def _rows(columns: dict[str, Tensor], rows: Tensor) -> dict[str, Tensor]:
    return {name: take(values, rows) for name, values in columns.items()}


def _fits(columns: dict[str, Tensor], device: torch.device) -> bool:
    """Return whether columns take at most half of the device's free memory."""
    if device.type != "cuda":
        return True
    free, _ = torch.cuda.mem_get_info(device)
    return sum(values.nbytes for values in columns.values()) <= free // 2
