"""Subset: one size of a paired dataset; smaller sizes are subsets of larger ones."""

from pathlib import Path

from astra_data.core.progress import Progress, silent
from astra_data.dataset import edit
from astra_data.dataset.reader import Dataset


def subset(dataset: Path, *, percent: int, of: int | None = None, out: Path, progress: Progress = silent) -> Path:
    """Write `percent` per cent of `of` episodes of `dataset` to `out`, as a dataset of its own.

    Its stored permutation decides which are taken; `percent` may exceed 100, which is by default all of them. Episodes
    that the dataset marks as held out are in every size, and no part of the percentage.
    """
    source = Dataset.open(dataset)
    held_out = set(source.uids[source.held_out].tolist())
    name = f"{source.description['name']}-percent{percent:03d}"
    folder = edit.subset(source, percent=percent, of=of, always=held_out, name=name, out=out)
    others = len(source) - len(held_out)
    progress(1.0, f"{edit.share(percent, of or others)} of {others} episodes")
    return folder
