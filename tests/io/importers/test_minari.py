import os
from pathlib import Path

import h5py
import numpy as np
import pytest
from minari_recordings import LENGTHS, episodes, write_minari
from recordings import LOG, imported

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED, Array


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_every_value_of_a_goal_dataset_arrives(tmp_path: Path, data_format: str) -> None:
    made = episodes(is_dict=True)
    for episode in made:
        episode["observations"]["camera"] = np.zeros((len(episode["rewards"]) + 1, 4, 4, 3), np.uint8)
    path = write_minari(tmp_path / "minari", made, data_format=data_format)
    dataset, report = imported(tmp_path, path, None, name="ant", fps=10)
    assert dataset.lengths.tolist() == list(LENGTHS) and report.tally.split_points == {"source": 1}
    assert "fields left out: observations/camera" in str(report)
    for got, episode in zip(dataset.episodes(), made, strict=True):
        parts = episode["observations"]
        state = np.concatenate([parts["achieved_goal"], parts["observation"]], axis=1).astype(np.float32)
        expected: dict[str, Array] = {
            STATE: state[:-1],
            NEXT_STATE: state[1:],
            GOAL: parts["desired_goal"][:-1].astype(np.float32),
            ACTION: episode["actions"].astype(np.float32),
            REWARD: np.array(episode["rewards"], np.float32),
            TERMINATED: np.array(episode["terminations"]),
            TRUNCATED: np.array(episode["truncations"]),
        }
        for name, values in expected.items():
            np.testing.assert_array_equal(got.columns[name], values, err_msg=name)


def test_a_mapping_chooses_other_fields(tmp_path: Path) -> None:
    made = episodes(is_dict=True)
    path = write_minari(tmp_path / "minari", made)
    mapping = f"""{LOG}[columns."observation.state"]
fields = ["observations/achieved_goal"]
"""
    dataset, _ = imported(tmp_path, path, mapping)
    assert dataset.lengths.tolist() == [length - 1 for length in LENGTHS]
    np.testing.assert_array_equal(
        next(dataset.episodes()).columns[STATE], made[0]["observations"]["achieved_goal"][:3].astype(np.float32)
    )


def test_infos_that_begin_with_the_resets_are_those_before_a_step_or_after_it(tmp_path: Path) -> None:
    """Minari's `DataCollector` records the info of the reset, too."""
    made = episodes(is_dict=True)
    for episode, length in zip(made, LENGTHS, strict=True):
        success = np.arange(length + 1) == length
        infos = {"qpos": np.arange(length + 1.0), "cost": -np.arange(1.0 * length), "success": success}
        episode["infos"] = infos | {"speed": np.arange(length + 1.0), "unused": success}
    path = write_minari(tmp_path / "minari", made)
    mapping = f"""{LOG}[columns."observation.state"]
fields = ["infos/qpos", "infos/cost"]
[columns."next.observation.state"]
fields = ["next_infos/qpos", "infos/cost"]
[columns."next.success"]
fields = ["infos/success"]
[columns.speed]
fields = ["infos/speed"]
"""
    dataset, report = imported(tmp_path, path, mapping)
    assert "infos/speed, infos/success: of one entry more than steps, each step has the one after it" in str(report)
    left = ["actions", "infos/unused", "observations/achieved_goal", "observations/desired_goal"]
    assert sorted(report.tally.unused_fields)[: len(left)] == left
    for got, length in zip(dataset.episodes(), LENGTHS, strict=True):
        steps = np.arange(length, dtype=np.float32)
        np.testing.assert_array_equal(got.columns[STATE], np.stack([steps, -steps], axis=1))
        np.testing.assert_array_equal(got.columns[NEXT_STATE], np.stack([steps + 1, -steps], axis=1))
        np.testing.assert_array_equal(got.columns["next.success"], steps == length - 1)
        np.testing.assert_array_equal(got.columns["speed"], steps + 1)
    both = mapping.replace('["infos/speed"]', '["infos/qpos"]')
    with pytest.raises(BadInputError, match=r"infos/qpos has an entry for the reset.* write next_infos/qpos"):
        imported(tmp_path / "both", path, both)


@pytest.mark.parametrize("link", [h5py.ExternalLink("secret.h5", "/"), h5py.SoftLink("/episode_1")])
def test_files_with_links_are_refused(tmp_path: Path, link: object) -> None:
    path = write_minari(tmp_path / "minari", episodes(is_dict=True))
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        del file["episode_0"]
        file["episode_0"] = link
    with pytest.raises(BadInputError, match="test-v1: episode_0: expected no links"):
        imported(tmp_path, path, None, name="ant", fps=10)


def test_a_dataset_that_unpacks_to_far_more_than_its_size_is_refused(tmp_path: Path) -> None:
    path = write_minari(tmp_path / "minari", episodes(is_dict=True))
    with pytest.raises(BadInputError, match=r"test-v1 holds values of \d+ bytes or more.*--max-bytes"):
        imported(tmp_path, path, None, name="ant", fps=10, max_bytes=100)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    path = write_minari(tmp_path / "minari", episodes(is_dict=True))
    (path / "data/main_data.hdf5").unlink()
    os.mkfifo(path / "data/main_data.hdf5")
    with pytest.raises(BadInputError, match="is a device or a pipe"):
        imported(tmp_path, path, None, name="ant", fps=10)
