from pathlib import Path

import h5py
import numpy as np
import pytest

from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED
from astra_data.dataset.reader import Dataset
from astra_data.io.exporters import d4rl, export


@pytest.mark.parametrize("block_rows", [5, 5000])
def test_d4rl_is_flat(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_rows: int
) -> None:
    monkeypatch.setattr(d4rl, "BLOCK_ROWS", block_rows)
    export(dataset, tmp_path / "set.hdf5", format="d4rl")
    names = {
        "observations": STATE,
        "actions": ACTION,
        "rewards": REWARD,
        "next_observations": NEXT_STATE,
        "terminals": TERMINATED,
        "infos/goal": GOAL,
    }
    expected = dataset.columns(list(names.values()))
    with h5py.File(tmp_path / "set.hdf5") as file:
        for key, name in names.items():
            np.testing.assert_array_equal(file[key][()], expected[name])
            assert file[key].dtype == expected[name].dtype
        ends = np.flatnonzero(file["terminals"][()] | file["timeouts"][()])
        assert not (file["terminals"][()] & file["timeouts"][()]).any()
    np.testing.assert_array_equal(ends, np.cumsum(dataset.lengths) - 1)
