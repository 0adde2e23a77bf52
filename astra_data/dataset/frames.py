"""Columns of chosen episodes as tensors, from which training draws windows and transitions."""

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.utils import data

from astra_data.core.durable import atomic_folder, held
from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.core.provenance import memory_bytes
from astra_data.core.seeding import generator
from astra_data.dataset.columns import Array
from astra_data.dataset.reader import Dataset

Padding = Literal["valid", "edge"]
MEMORY_SHARE = 0.5  # columns that take more than this share of the machine's memory are memory-mapped
IS_PAD = "is_pad"
Batch = dict[str, Tensor]  # column name to (B, ...)


class Samples(data.Dataset[Batch]):
    """Samples of one shape, drawn one by one or in batches; a `DataLoader` needs a `collate_fn` of no effect."""

    def __init__(self, first: Tensor, gather: Callable[[Tensor], Batch], device: torch.device) -> None:
        # Samples begin at rows `first` (M,), and `gather` reads those at rows (B,).
        self._first, self._gather, self._device = first, gather, device

    def __len__(self) -> int:
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

    def batches(self, batch_size: int, *, seed: int = 0, shuffle: bool = True) -> "Batches":
        """Draw batches, reshuffled each epoch by `seed` and its number; the last of an epoch may be smaller."""
        return Batches(self, batch_size, seed=seed, shuffle=shuffle)


class Batches:
    """Batches of `samples`, the rest of an epoch per iteration; goes on from `batch` of `epoch`."""

    def __init__(self, samples: Samples, batch_size: int, *, seed: int, shuffle: bool) -> None:
        if batch_size < 1:
            raise BadInputError(f"batches of {batch_size} samples: expected at least 1")
        self._samples = samples
        self._settings = {"count": len(samples), "batch_size": batch_size, "seed": seed, "shuffle": shuffle}
        self.epoch = self.batch = 0

    def __len__(self) -> int:
        return -(-len(self._samples) // self._settings["batch_size"])

    def __iter__(self) -> Iterator[Batch]:
        epoch, count, size = self.epoch, self._settings["count"], self._settings["batch_size"]
        order = torch.arange(count)
        if self._settings["shuffle"]:
            numbers = generator(self._settings["seed"], f"order of epoch {epoch}")
            order = torch.from_numpy(numbers.permutation(count))
        for batch in range(self.batch, len(self)):
            # Set before yielding, so that a state saved inside the loop names the next batch.
            self.epoch, self.batch = (epoch, batch + 1) if batch + 1 < len(self) else (epoch + 1, 0)
            yield self._samples.__getitems__(order[batch * size : (batch + 1) * size])

    def state_dict(self) -> dict[str, Any]:
        """Return the settings and the next batch: plain numbers, for `load_state_dict`."""
        return {**self._settings, "epoch": self.epoch, "batch": self.batch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state`, unless it belongs to another order or names a batch that does not exist."""
        epoch, batch = state.get("epoch"), state.get("batch")
        settings = {key: state.get(key) for key in self._settings}
        is_batch = type(epoch) is int and epoch >= 0 and type(batch) is int and 0 <= batch < len(self)
        if settings != self._settings or not is_batch:
            wanted = f"expected {self._settings} and a batch of 0 to {len(self) - 1}, got {state}"
            raise BadInputError(f"the state is of another order of samples: {wanted}")
        self.epoch, self.batch = state["epoch"], state["batch"]


@dataclass(frozen=True, eq=False, repr=False)
class Frames:
    """The steps of E episodes.

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
        cameras: Sequence[str] = (),
    ) -> "Frames":
        """Load whole columns `names`, by default all of `dataset.schema`, and the decoded pictures of `cameras`.

        Columns of more than `memory_share` of the machine's memory are memory-mapped from raw files instead.
        Columns that do not fit on a CUDA device stay in main memory, and each batch is moved to the device.

        Args:
            dataset: the dataset.
            names: names of the columns.
            episodes: indices of the episodes, by default all; they come in the dataset's order.
            device: torch device of the batches.
            memory_share: 0 to memory-map always.
            cache: folder of the raw files, by default $ASTRA_DATA_CACHE, or else ~/.cache/astra-data.
            cameras: names of cameras; their pictures, (N, H, W, 3) uint8, have to fit into main memory.
        """
        names = [column.name for column in dataset.schema] if names is None else names
        chosen = dataset.selected(episodes)
        lengths = dataset.lengths[chosen]
        step_bytes = sum(column.size * np.dtype(column.dtype).itemsize for column in dataset.specs(names))
        if step_bytes * int(lengths.sum()) > memory_share * memory_bytes():
            home = os.environ.get("ASTRA_DATA_CACHE", Path.home() / ".cache" / "astra-data")
            arrays = mapped_columns(dataset, names, cache or Path(home))
            starts, shown = dataset.starts[chosen], dataset.selected(None)
        else:
            arrays = dataset.columns(names, episodes)
            starts, shown = np.cumsum(lengths) - lengths, chosen
        for name in cameras:
            arrays[name] = np.concatenate([dataset.pictures(name, int(number)) for number in shown])
        columns = {name: torch.from_numpy(values) for name, values in arrays.items()}
        target = torch.device(device)
        size = sum(values.nbytes for values in columns.values())
        fits = target.type != "cuda" or size <= torch.cuda.mem_get_info(target)[0] // 2
        storage = target if fits else torch.device("cpu")
        columns = {name: values.to(storage) for name, values in columns.items()}
        return cls(columns, torch.from_numpy(starts).to(storage), torch.from_numpy(lengths).to(storage), target)

    def __len__(self) -> int:
        return int(self.lengths.sum())

    def __repr__(self) -> str:
        columns = ", ".join(f"{name} {tuple(values.shape[1:])}" for name, values in self.columns.items())
        return f"Frames({len(self.lengths)} episodes, {len(self)} steps, {columns}, to {self.device})"

    def windows(self, length: int, *, padding: Padding = "valid", past: int = 0) -> Samples:
        """Return windows of L consecutive steps of one episode, with "is_pad" (L,), true outside of it.

        Padding "valid" gives windows inside their episode; "edge" one at every step t, which begins `past` steps
        before t and is padded with the first or the last step, as in lerobot's `delta_timestamps`.
        A BadInputError lists every argument that is out of range.
        """
        longest = int(self.lengths.max())
        is_valid, is_edge = padding == "valid", padding == "edge"
        checks = {
            f"length {length}, expected at least 1": length < 1,
            f"length {length}, expected at most {longest}, the longest episode's, or padding 'edge'": (
                is_valid and length > longest
            ),
            f"past {past}, expected 0 without padding 'edge'": is_valid and past,
            f"past {past}, expected 0 to {length - 1}": is_edge and not 0 <= past < max(length, 1),
            f"padding {padding!r}, expected 'valid' or 'edge'": not is_valid and not is_edge,
        }
        if faults := [fault for fault, is_one in checks.items() if is_one]:
            raise BadInputError(f"Windows: {'; '.join(faults)}.")
        counts = self.lengths if is_edge else (self.lengths - length + 1).clamp_min(0)
        first = _every(self.starts - past, counts)
        return Samples(first, partial(self._windows, past, length), self.device)

    def transitions(self) -> Samples:
        """Return single steps; the step's outcome is in its columns `next.*`."""
        return Samples(_every(self.starts, self.lengths), self._rows, self.device)

    def _rows(self, rows: Tensor) -> Batch:
        return {name: take(values, rows) for name, values in self.columns.items()}

    def _windows(self, past: int, length: int, first: Tensor) -> Batch:
        """Return the windows at rows `first` (B,), which may lie outside; step `past` is in the episode."""
        episode = torch.searchsorted(self.starts, first + past, right=True) - 1
        wanted = first[:, None] + torch.arange(length, device=first.device)
        ends = self.starts + self.lengths
        rows = wanted.clamp(self.starts[episode, None], ends[episode, None] - 1)
        batch = self._rows(rows.view(-1))
        shaped = {name: values.view(*rows.shape, *values.shape[1:]) for name, values in batch.items()}
        return shaped | {IS_PAD: rows != wanted}


def _every(begins: Tensor, counts: Tensor) -> Tensor:
    """Return the `counts` (E,) rows from each of `begins` (E,) on."""
    number = torch.arange(int(counts.sum()), device=begins.device)
    return number.add_((begins - (counts.cumsum(0) - counts)).repeat_interleave(counts))


def take(values: Tensor, rows: Tensor) -> Tensor:
    """Return the rows `rows` (n,) of `values` (N, ...)."""
    if values.device.type != "cpu" or not values.is_contiguous():
        return values.index_select(0, rows)
    # For many short rows numpy is faster; of an array that is not contiguous it would first copy all.
    return torch.from_numpy(values.numpy().take(rows.numpy(), axis=0))


def mapped_columns(dataset: Dataset, names: Sequence[str], cache: Path) -> dict[str, Array]:
    """Memory-map whole columns, (N, size) or (N,), from raw files in `cache`; one process writes missing ones."""
    parent = cache / dataset.content_hash
    parent.mkdir(parents=True, exist_ok=True)
    with held(parent, wait=True):
        for column in dataset.specs(names):
            if (parent / column.name).exists():
                continue
            shape = (int(dataset.lengths.sum()), column.size)[: 1 + (column.size > 1)]
            header = {"descr": np.dtype(column.dtype).str, "fortran_order": False, "shape": shape}
            # Not as a memory map: where the disk is full, that would end the process with a bus error.
            with atomic_folder(parent / column.name) as unfinished, (unfinished / "values.npy").open("wb") as file:
                np.lib.format.write_array_header_1_0(file, header)  # type: ignore[no-untyped-call]
                for block in dataset.blocks([column.name]):
                    file.write(block[column.name].data)
    try:
        columns = {name: np.load(parent / name / "values.npy", mmap_mode="c") for name in names}
        faults = list(dataset.alterations(columns, dataset.selected(None)))
    except (OSError, ValueError) as error:
        faults = [str(error)]
    if faults:
        raise CorruptDatasetError(f"{parent} was altered ({faults[0]}); delete it and try again.")
    return columns
