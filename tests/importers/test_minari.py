import sys
import warnings
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from recordings import MAPPING, imported

from astra_data.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED, Array
from astra_data.errors import BadInputError

LENGTHS = (4, 7)


def box(size: int) -> spaces.Space[Any]:
    return spaces.Box(-np.inf, np.inf, (size,), np.float64)


def episodes(*, is_dict: bool) -> list[dict[str, Any]]:
    rng = np.random.default_rng(0)
    made = []
    for length in LENGTHS:
        parts = {"observation": 3, "achieved_goal": 2, "desired_goal": 2}
        observations: Any = {name: rng.normal(size=(length + 1, size)) for name, size in parts.items()}
        made.append(
            {
                "observations": observations if is_dict else observations["observation"],
                "actions": rng.normal(size=(length, 2)),
                "rewards": rng.normal(size=length).tolist(),
                "terminations": [length == 4 and step == 3 for step in range(length)],
                "truncations": [length == 7 and step == 6 for step in range(length)],
            }
        )
    return made


def write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: list[dict[str, Any]], data_format: str = "hdf5"
) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    is_dict = isinstance(made[0]["observations"], dict)
    parts = {"observation": box(3), "achieved_goal": box(2), "desired_goal": box(2)}
    # Minari warns about the environment and the like, which these datasets do not have.
    warnings.simplefilter("ignore", UserWarning)
    minari.create_dataset_from_buffers(
        "ant/test-v1",
        [EpisodeBuffer(id=index, infos={}, **episode) for index, episode in enumerate(made)],
        observation_space=spaces.Dict(parts) if is_dict else box(3),
        action_space=box(2),
        algorithm_name="none",
        author="nobody",
        author_email="nobody@example.org",
        code_permalink="https://example.org",
        data_format=data_format,
    )
    return tmp_path / "minari" / "ant" / "test-v1"


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_every_value_of_a_goal_dataset_arrives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data_format: str
) -> None:
    made = episodes(is_dict=True)
    path = write(tmp_path, monkeypatch, made, data_format=data_format)
    dataset, report = imported(tmp_path, path, None, name="ant", fps=10)
    assert dataset.lengths.tolist() == list(LENGTHS)
    assert report.tally.split_points == {"source": 1}
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


def test_a_mapping_chooses_other_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = episodes(is_dict=True)
    path = write(tmp_path, monkeypatch, made)
    mapping = """
name = "ant"
task = "walk"
fps = 10
[columns."observation.state"]
fields = ["observations/achieved_goal"]
"""
    dataset, _ = imported(tmp_path, path, mapping)
    assert dataset.lengths.tolist() == [length - 1 for length in LENGTHS]
    np.testing.assert_array_equal(
        next(dataset.episodes()).columns[STATE],
        made[0]["observations"]["achieved_goal"][:3].astype(np.float32),
    )


def test_fields_that_are_missing_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, monkeypatch, episodes(is_dict=False))
    with pytest.raises(BadInputError, match=r"no field 'x'; known: .*observations"):
        imported(tmp_path, path, MAPPING)


def test_a_folder_without_a_dataset_is_told(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="expected the folder of a Minari dataset"):
        imported(tmp_path, tmp_path, None, name="ant", fps=10, file_format="minari")


def test_a_missing_extra_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, monkeypatch, episodes(is_dict=False))
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(BadInputError, match=r'pip install "astra-data\[minari\]"'):
        imported(tmp_path, path, None, name="ant", fps=10)
