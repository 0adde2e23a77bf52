"""robomimic: one HDF5 file with a group per demonstration."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from astra_data.dataset.columns import GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED
from astra_data.dataset.compare import recordings_of
from astra_data.dataset.reader import Dataset
from astra_data.io.export_record import Export
from astra_data.io.hdf5_file import hdf5_file
from astra_data.io.layouts import RECORD, ROBOMIMIC, as_stored, fields_of

VALID_SHARE = 0.1
"""Share of the recordings in mask/valid, as in robomimic's own split; the others are in mask/train."""
_GYM = 2
"""robomimic's code for gym environments."""


def write(dataset: Dataset, path: Path, out: Path) -> None:
    """Write data/demo_i: actions (T, A), rewards, dones, truncated (T,), obs/state, next_obs/state (T, S).

    `dones` is terminated alone: robomimic's learners do not bootstrap on it. `truncated` is read by our own
    importer only. Goals (T, G) become obs/goal and next_obs/goal, other columns infos/<name>. mask/train
    and mask/valid follow the permutation of the nested subsets, by recordings with all copies of them;
    mask/valid is what an augmentation held out, if it did. A dataset of few episodes has only mask/train.
    """
    names = [column.name for column in dataset.schema]
    own = {**ROBOMIMIC, STATE: "obs/state", NEXT_STATE: "next_obs/state", GOAL: "obs/goal"}
    fields = fields_of(names, own)
    exported = Export(dataset, fields, groups="data/demo_*")
    environment = dataset.description["environment"]
    arguments = {
        "env_name": environment.get("id", dataset.description["name"]),
        "type": _GYM,
        "env_kwargs": {key: value for key, value in environment.items() if key != "id"},
    }
    with hdf5_file(path) as (file, disk):
        data = file.create_group("data")
        data.attrs["total"] = int(dataset.lengths.sum())
        data.attrs["env_args"] = json.dumps(arguments)
        for number, episode in enumerate(disk.until_it_fails(exported.episodes())):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = len(episode)
            demo.attrs["episode_uid"] = episode.uid
            values = {name: as_stored(name, column) for name, column in episode.columns.items()}
            for name in (TERMINATED, TRUNCATED):
                values[name] = values[name].astype("int64")
            for name, field in fields.items():
                demo[field] = values[name]
            if REWARD not in fields:
                demo[ROBOMIMIC[REWARD]] = np.zeros(len(episode), np.float32)
            if GOAL in fields:
                demo["next_obs/goal"] = values[GOAL]
        is_valid = _validation(dataset)
        for key, part in (("train", ~is_valid), ("valid", is_valid)):
            if part.any():
                file[f"mask/{key}"] = [f"demo_{episode}".encode() for episode in np.flatnonzero(part)]
        file[RECORD] = exported.text()


def _validation(dataset: Dataset) -> NDArray[np.bool_]:
    """Return which episodes (E,) are for validation; copies go where their recording goes."""
    recordings = recordings_of(dataset)
    held_out = np.array(dataset.metadata.get("held_out", [False] * len(dataset)), dtype=bool)
    if held_out.any():
        return np.isin(recordings, recordings[held_out])
    ordered = list(dict.fromkeys(recordings[dataset.order].tolist()))
    train = len(ordered) - int(len(ordered) * VALID_SHARE)
    return np.isin(recordings, ordered[train:])
