"""d3rlpy: the HDF5 file that its `ReplayBuffer.load` reads (version 2.1 of its layout)."""

from pathlib import Path

import numpy as np

from astra_data.dataset.columns import ACTION, GOAL, REWARD, STATE, TERMINATED
from astra_data.dataset.reader import Dataset
from astra_data.io.export_record import Export
from astra_data.io.hdf5_file import hdf5_file
from astra_data.io.layouts import D3RLPY, NUMBERED, RECORD, as_stored, fields_of

VERSION = "2.1"


def write(dataset: Dataset, path: Path, out: Path) -> None:
    """Write per episode i observations_i (T, S + G), actions_i (T, A), rewards_i (T, 1) and terminated_i.

    Its algorithms take one observation, so the goal, where there is one, follows the state. Other columns
    become infos/<name>_i, which it leaves alone.
    """
    names = [column.name for column in dataset.schema]
    own = {name: field for name, field in D3RLPY.items() if name != TERMINATED} | {GOAL: D3RLPY[STATE]}
    fields = fields_of(names, own)
    [state] = dataset.specs([STATE])
    exported = Export(dataset, fields, groups=NUMBERED, first={GOAL: state.size})
    observed = [STATE, GOAL] if GOAL in names else [STATE]
    apart = [name for name in names if name not in (*observed, ACTION, REWARD)]
    with hdf5_file(path) as (file, disk):
        file["columns"] = list(D3RLPY.values())
        file["num_episodes"] = len(dataset)
        file["version"] = VERSION
        for number, episode in enumerate(disk.until_it_fails(exported.episodes())):
            values, length = episode.columns, len(episode)
            parts = [as_stored(name, values[name]) for name in observed]
            file[f"observations_{number}"] = np.concatenate(parts, axis=1)
            file[f"actions_{number}"] = as_stored(ACTION, values[ACTION])
            file[f"rewards_{number}"] = values.get(REWARD, np.zeros(length, np.float32))[:, None]
            file[f"terminated_{number}"] = bool(values[TERMINATED][-1])
            for name in apart:
                file[f"{fields[name]}_{number}"] = as_stored(name, values[name])
        file[RECORD] = exported.text()
