"""D4RL: one HDF5 file with all transitions one after another."""

from pathlib import Path

import numpy as np

from astra_data.core.optional import optional
from astra_data.dataset.atomic import atomic_file
from astra_data.dataset.columns import TERMINATED, TRUNCATED
from astra_data.dataset.reader import Dataset
from astra_data.exchange.layouts import D4RL


def export(dataset: Dataset, out: Path) -> None:
    """Write observations (N, S), actions (N, A), rewards, terminals, timeouts (N,), next_observations (N, S).

    Goals (N, G) become infos/goal. The last step of every episode is a terminal or a timeout, since
    nothing else separates the episodes.
    """
    h5py = optional("h5py", "hdf5")
    rows = int(dataset.lengths.sum())
    columns = [column for column in dataset.schema if column.name in D4RL]
    with atomic_file(out) as path, h5py.File(path, "w") as file:
        for column in columns:
            shape = (rows,) if column.size == 1 else (rows, column.size)
            file.create_dataset(D4RL[column.name], shape, column.dtype)
        first = 0
        for episode in dataset.episodes([column.name for column in columns]):
            values = dict(episode.columns)
            is_last = np.arange(len(episode)) == len(episode) - 1
            values[TRUNCATED] = (values[TRUNCATED] | is_last) & ~values[TERMINATED]
            for name, array in values.items():
                file[D4RL[name]][first : first + len(episode)] = array
            first += len(episode)
