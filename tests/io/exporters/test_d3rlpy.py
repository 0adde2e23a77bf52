from pathlib import Path

import h5py
import numpy as np

from astra_data.dataset.columns import ACTION, GOAL, REWARD, STATE, TERMINATED
from astra_data.dataset.reader import Dataset
from astra_data.io.exporters import export


def test_d3rlpy_has_arrays_per_episode(dataset: Dataset, tmp_path: Path) -> None:
    export(dataset, tmp_path / "set.h5", format="d3rlpy")
    with h5py.File(tmp_path / "set.h5") as file:
        assert file["version"][()] == b"2.1"
        assert file["num_episodes"][()] == 5
        assert [key.decode() for key in file["columns"][()]] == [
            "observations",
            "actions",
            "rewards",
            "terminated",
        ]
        for number, episode in enumerate(dataset.episodes()):
            values = episode.columns
            observations = np.concatenate([values[STATE], values[GOAL]], axis=1)
            np.testing.assert_array_equal(file[f"observations_{number}"][()], observations)
            np.testing.assert_array_equal(file[f"actions_{number}"][()], values[ACTION])
            np.testing.assert_array_equal(file[f"rewards_{number}"][()], values[REWARD][:, None])
            assert file[f"terminated_{number}"][()] == values[TERMINATED][-1]
