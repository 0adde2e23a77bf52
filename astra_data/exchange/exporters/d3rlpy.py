"""d3rlpy: the HDF5 file that its `ReplayBuffer.load` reads (version 2.1 of its layout)."""

from pathlib import Path

import numpy as np

from astra_data.core.optional import optional
from astra_data.dataset.atomic import atomic_file
from astra_data.dataset.columns import ACTION, GOAL, REWARD, STATE, TERMINATED
from astra_data.dataset.reader import Dataset

VERSION = "2.1"


def export(dataset: Dataset, out: Path) -> None:
    """Write per episode i observations_i (T, S + G), actions_i (T, A), rewards_i (T, 1) and terminated_i.

    Its algorithms take one observation, so the goal, where there is one, follows the state.
    """
    h5py = optional("h5py", "hdf5")
    observed = [STATE, GOAL] if GOAL in dataset.features else [STATE]
    with atomic_file(out) as path, h5py.File(path, "w") as file:
        file["columns"] = ["observations", "actions", "rewards", "terminated"]
        file["num_episodes"] = len(dataset)
        file["version"] = VERSION
        for number, episode in enumerate(dataset.episodes([*observed, ACTION, REWARD, TERMINATED])):
            parts = [episode.columns[name].reshape(len(episode), -1) for name in observed]
            file[f"observations_{number}"] = np.concatenate(parts, axis=1)
            file[f"actions_{number}"] = episode.columns[ACTION].reshape(len(episode), -1)
            file[f"rewards_{number}"] = episode.columns[REWARD][:, None]
            file[f"terminated_{number}"] = bool(episode.columns[TERMINATED][-1])
