"""Subset: one size of a paired dataset; smaller sizes are subsets of larger ones."""

from pathlib import Path

from astra_data.core.progress import Progress, silent
from astra_data.dataset import edit
from astra_data.dataset.reader import Dataset


def subset(dataset: Path, *, percent: int, of: int | None = None, out: Path, progress: Progress = silent) -> Path:
    """Write `percent` per cent of `of` episodes of `dataset` to `out`, as a dataset of its own.

    Its stored permutation decides which are taken; `percent` may exceed 100, which is by default all of them.
    """
    source = Dataset.open(dataset)
    name = f"{source.description['name']}-percent{percent:03d}"
    folder = edit.subset(source, percent=percent, of=of, name=name, out=out)
    progress(1.0, f"{edit.share(percent, of or len(source))} of {len(source)} episodes")
    return folder
