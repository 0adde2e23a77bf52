"""D4RL: one HDF5 file with all transitions one after another."""

from pathlib import Path

import numpy as np

from astra_data.dataset.columns import REWARD, TERMINATED, TRUNCATED
from astra_data.dataset.reader import Dataset
from astra_data.exchange.export_record import Export
from astra_data.exchange.hdf5_file import hdf5_file
from astra_data.exchange.layouts import D4RL, RECORD, extra_fields


def write(dataset: Dataset, path: Path, out: Path) -> None:
    """Write observations (N, S), actions (N, A), rewards, terminals, timeouts (N,), next_observations (N, S).

    Goals (N, G) become infos/goal, other columns infos/<name>. The last step of every episode is a terminal
    or a timeout, since nothing else separates the episodes; next.truncated itself lies in infos, too.
    """
    own = {name: field for name, field in D4RL.items() if name != TRUNCATED}
    names = [column.name for column in dataset.schema]
    fields = extra_fields(names, own) | {name: field for name, field in own.items() if name in names}
    exported = Export(dataset, fields)
    rows = int(dataset.lengths.sum())
    with hdf5_file(path) as (file, disk):
        for column in dataset.schema:
            shape = (rows,) if column.size == 1 else (rows, column.size)
            file.create_dataset(fields[column.name], shape, column.dtype)
        file.create_dataset(D4RL[TRUNCATED], (rows,), bool)
        if REWARD not in fields:
            file[D4RL[REWARD]] = np.zeros(rows, np.float32)
        first = 0
        for episode in disk.until_it_fails(exported.episodes()):
            part = slice(first, first + len(episode))
            for name, values in episode.columns.items():
                file[fields[name]][part] = values
            is_last = np.arange(len(episode)) == len(episode) - 1
            timeouts = (episode.columns[TRUNCATED] | is_last) & ~episode.columns[TERMINATED]
            file[D4RL[TRUNCATED]][part] = timeouts
            first += len(episode)
        file[RECORD] = exported.text()
