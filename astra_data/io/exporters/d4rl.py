"""D4RL: one HDF5 file with all transitions one after another."""

from pathlib import Path

import numpy as np

from astra_data.dataset.columns import REWARD, TERMINATED, TRUNCATED, Array, Episode, in_blocks
from astra_data.dataset.reader import Dataset
from astra_data.io.export_record import Export
from astra_data.io.hdf5_file import hdf5_file
from astra_data.io.layouts import D4RL, RECORD, VECTORS, as_stored, fields_of
from astra_data.io.recording import BLOCK_ROWS


def write(dataset: Dataset, path: Path, out: Path) -> None:
    """Write observations (N, S), actions (N, A), rewards, terminals, timeouts (N,), next_observations (N, S).

    Goals (N, G) become infos/goal, other columns infos/<name>. The last step of every episode is a terminal
    or a timeout, since nothing else separates the episodes; next.truncated itself lies in infos, too.
    """
    own = {name: field for name, field in D4RL.items() if name != TRUNCATED}
    names = [column.name for column in dataset.schema]
    fields = fields_of(names, own)
    exported = Export(dataset, fields)
    rows = int(dataset.lengths.sum())
    with hdf5_file(path) as (file, disk):
        for column in dataset.schema:
            shape = (rows,) if column.size == 1 and column.name not in VECTORS else (rows, column.size)
            file.create_dataset(fields[column.name], shape, column.dtype)
        file.create_dataset(D4RL[TRUNCATED], (rows,), bool)
        if REWARD not in fields:
            file[D4RL[REWARD]] = np.zeros(rows, np.float32)
        first = 0
        for block in disk.until_it_fails(in_blocks(exported.episodes(), BLOCK_ROWS)):
            part = slice(first, first + sum(map(len, block)))
            for name in block[0].columns:
                values = np.concatenate([episode.columns[name] for episode in block])
                file[fields[name]][part] = as_stored(name, values)
            file[D4RL[TRUNCATED]][part] = np.concatenate([_timeouts(episode) for episode in block])
            first = part.stop
        file[RECORD] = exported.text()


def _timeouts(episode: Episode) -> Array:
    is_last = np.arange(len(episode)) == len(episode) - 1
    timeouts: Array = (episode.columns[TRUNCATED] | is_last) & ~episode.columns[TERMINATED]
    return timeouts
