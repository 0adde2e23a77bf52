"""D4RL: one HDF5 file with all transitions one after another."""

from pathlib import Path

import numpy as np

from astra_data.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED
from astra_data.dataset.atomic import atomic_file
from astra_data.dataset.reader import Dataset

_NAMES = {
    STATE: "observations",
    ACTION: "actions",
    REWARD: "rewards",
    NEXT_STATE: "next_observations",
    TERMINATED: "terminals",
    TRUNCATED: "timeouts",
    GOAL: "infos/goal",
}


def export(dataset: Dataset, out: Path) -> None:
    """Write observations (N, S), actions (N, A), rewards, terminals, timeouts (N,), next_observations (N, S).

    Goals (N, G) become infos/goal. The last step of every episode is a terminal or a timeout, since there is
    nothing else to tell the episodes apart.
    """
    import h5py  # noqa: PLC0415 - an extra

    rows = int(dataset.lengths.sum())
    columns = [column for column in dataset.schema if column.name in _NAMES]
    with atomic_file(out) as path, h5py.File(path, "w") as file:
        for column in columns:
            shape = (rows,) if column.size == 1 else (rows, column.size)
            file.create_dataset(_NAMES[column.name], shape, column.dtype)
        first = 0
        for episode in dataset.episodes([column.name for column in columns]):
            values = dict(episode.columns)
            is_last = np.arange(len(episode)) == len(episode) - 1
            values[TRUNCATED] = (values[TRUNCATED] | is_last) & ~values[TERMINATED]
            for name, array in values.items():
                file[_NAMES[name]][first : first + len(episode)] = array
            first += len(episode)
