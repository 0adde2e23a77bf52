"""Minari datasets for tests, as Minari writes them."""

import warnings
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

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


def write_minari(folder: Path, made: list[dict[str, Any]], data_format: str = "hdf5") -> Path:
    """Write a dataset below `folder`, and return its own folder."""
    is_dict = isinstance(made[0]["observations"], dict)
    parts = {"observation": box(3), "achieved_goal": box(2), "desired_goal": box(2)}
    if is_dict and "camera" in made[0]["observations"]:
        parts["camera"] = spaces.Box(0, 255, (4, 4, 3), np.uint8)
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings(action="ignore"):
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        minari.create_dataset_from_buffers(  # it warns that there is no environment, no description and the like
            "ant/test-v1",
            [EpisodeBuffer(id=index, **{"infos": {}} | episode) for index, episode in enumerate(made)],
            observation_space=spaces.Dict(parts) if is_dict else box(3),
            action_space=box(2),
            data_format=data_format,
        )
    return folder / "ant/test-v1"
