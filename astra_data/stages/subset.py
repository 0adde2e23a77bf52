"""Subset: one size of a paired dataset; smaller ones lie inside larger ones."""

from pathlib import Path

from astra_data.core.progress import Progress
from astra_data.dataset import edit
from astra_data.dataset.reader import Dataset


def subset(dataset: Path, *, percent: int, of: int, out: Path, progress: Progress) -> Path:
    """Write `percent` per cent of `of` episodes of `dataset` to `out`, as a dataset of its own.

    Args:
        dataset: whose own permutation says which episodes.
        percent: the size; may exceed 100.
        of: how many episodes 100 per cent are.
        out: the folder to write.
        progress: told the episodes.

    Raises:
        BadInputError: `dataset` has fewer episodes, or `out` exists.
        CorruptDatasetError: `dataset` is incomplete or was altered.
    """
    source = Dataset.open(dataset)
    name = f"{source.description['name']}-percent{percent:03d}"
    folder = edit.subset(source, percent=percent, of=of, name=name, out=out)
    progress(1.0, f"{edit.share(percent, of)} of {len(source)} episodes")
    return folder
