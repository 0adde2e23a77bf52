"""robomimic: one HDF5 file with a group per demonstration."""

import json
from pathlib import Path

from astra_data.core.optional import optional
from astra_data.dataset.atomic import atomic_file
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED
from astra_data.dataset.reader import Dataset
from astra_data.exchange.layouts import ROBOMIMIC

VALID_SHARE = 0.1
"""Share of the episodes in mask/valid, as in robomimic's own split; the others are in mask/train."""
_GYM = 2
"""robomimic's code for gym environments."""


def export(dataset: Dataset, out: Path) -> None:
    """Write data/demo_i: actions (T, A), rewards, dones, truncated (T,), obs/state, next_obs/state (T, S).

    `dones` is terminated alone: robomimic's learners do not bootstrap on it. `truncated` is read by our own
    importer only. Goals (T, G) become obs/goal and next_obs/goal. mask/train and mask/valid follow the
    permutation of the nested subsets; a dataset of a single episode has only mask/train.
    """
    h5py = optional("h5py", "hdf5")
    goal = [GOAL] if GOAL in dataset.features else []
    environment = dataset.description["environment"]
    arguments = {
        "env_name": environment.get("id", dataset.description["name"]),
        "type": _GYM,
        "env_kwargs": {key: value for key, value in environment.items() if key != "id"},
    }
    columns = [STATE, *goal, ACTION, REWARD, TERMINATED, TRUNCATED, NEXT_STATE]
    with atomic_file(out) as path, h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = int(dataset.lengths.sum())
        data.attrs["env_args"] = json.dumps(arguments)
        for number, episode in enumerate(dataset.episodes(columns)):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = len(episode)
            demo.attrs["episode_uid"] = episode.uid
            values = dict(episode.columns)
            values[ACTION] = values[ACTION].reshape(len(episode), -1)
            for name in (TERMINATED, TRUNCATED):
                values[name] = values[name].astype("int64")
            for name, key in ROBOMIMIC.items():
                demo[key] = values[name]
            demo["obs/state"], demo["next_obs/state"] = values[STATE], values[NEXT_STATE]
            for name in goal:
                demo["obs/goal"] = demo["next_obs/goal"] = values[name]
        train = len(dataset) - int(len(dataset) * VALID_SHARE)
        for key, part in (("train", dataset.order[:train]), ("valid", dataset.order[train:])):
            if part:
                file[f"mask/{key}"] = [f"demo_{episode}".encode() for episode in sorted(part)]
