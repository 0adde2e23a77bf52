import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from fake_dataset import COLUMNS, fake_columns, writer
from fake_transitions import NEXT

from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED, Episode
from astra_data.dataset.reader import Dataset
from astra_data.io.exporters import export


def test_robomimic_has_a_group_per_demonstration(dataset: Dataset, tmp_path: Path) -> None:
    export(dataset, tmp_path / "set.hdf5", format="robomimic")
    with h5py.File(tmp_path / "set.hdf5") as file:
        assert file["data"].attrs["total"] == 55
        assert json.loads(file["data"].attrs["env_args"]) == {
            "env_name": "Fake-v0",
            "type": 2,
            "env_kwargs": {},
        }
        assert sorted(file["data"]) == [f"demo_{number}" for number in range(5)]
        for number, episode in enumerate(dataset.episodes()):
            demo, values = file[f"data/demo_{number}"], episode.columns
            assert demo.attrs["num_samples"] == len(episode)
            for key, name in (
                ("actions", ACTION),
                ("rewards", REWARD),
                ("obs/state", STATE),
                ("obs/goal", GOAL),
                ("next_obs/state", NEXT_STATE),
            ):
                np.testing.assert_array_equal(demo[key][()], values[name])
            np.testing.assert_array_equal(demo["dones"][()], values[TERMINATED])
            np.testing.assert_array_equal(demo["truncated"][()], values[TRUNCATED])
        assert [name.decode() for name in file["mask/train"][()]] == [f"demo_{number}" for number in range(5)]
        assert "valid" not in file["mask"]


def test_robomimics_masks_share_the_episodes(tmp_path: Path) -> None:
    with writer(tmp_path / "set", columns=[*COLUMNS, NEXT]) as open_writer:
        for uid in range(20):
            columns = fake_columns(2, seed=uid)
            open_writer.add(Episode(uid, columns | {NEXT_STATE: columns[STATE]}))
    dataset = Dataset.open(tmp_path / "set")
    export(dataset, tmp_path / "set.hdf5", format="robomimic")
    with h5py.File(tmp_path / "set.hdf5") as file:
        train, valid = set(file["mask/train"][()]), set(file["mask/valid"][()])
        assert (len(train), len(valid)) == (18, 2)
        assert valid == {f"demo_{number}".encode() for number in dataset.order[18:]}  # in no smaller subset
        assert train | valid == {name.encode() for name in file["data"]}


@pytest.mark.parametrize("held_out", [None, 3, 4])
def test_copies_of_a_recording_are_on_its_side_of_robomimics_masks(
    tmp_path: Path, held_out: int | None
) -> None:
    with writer(tmp_path / "set", columns=[*COLUMNS, NEXT]) as open_writer:
        for uid in range(40):
            columns = fake_columns(2, seed=uid)
            metadata: dict[str, int | bool] = {"source_episode": uid % 10} if uid >= 10 else {}
            if held_out is not None:
                metadata["held_out"] = uid % 10 == held_out and uid < 20
            open_writer.add(Episode(uid, columns | {NEXT_STATE: columns[STATE]}, metadata))
    export(Dataset.open(tmp_path / "set"), tmp_path / "set.hdf5", format="robomimic")
    with h5py.File(tmp_path / "set.hdf5") as file:
        train, valid = (
            [int(name.decode().removeprefix("demo_")) for name in file[f"mask/{key}"][()]]
            for key in ("train", "valid")
        )
    assert sorted(train + valid) == list(range(40))
    (recording,) = {episode % 10 for episode in valid}
    assert sorted(valid) == [recording + 10 * number for number in range(4)]
    assert held_out in (None, recording)
