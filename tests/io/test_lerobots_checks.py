"""A dataset that our stages made passes what lerobot itself checks: frames, statistics."""

import json
import shutil
import warnings
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from astra_data.core.progress import silent
from astra_data.dataset.reader import Dataset
from astra_data.pipeline.stages.collect import CollectConfig, collect
from astra_data.pipeline.stages.pair import pair

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
TASK = f"{Path(__file__).parents[1] / 'small_cart.py'}:TASK"


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimpleNamespace]:
    """The modules of lerobot with checks in them, with a cache of their own and no network."""
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.setenv("HF_HUB_OFFLINE", "1")
        names = ("dataset_tools", "feature_utils", "lerobot_dataset")
        modules = {name: import_module(f"lerobot.datasets.{name}") for name in names}
        cache = tmp_path_factory.mktemp("cache")
        patch.setattr(import_module("datasets").config, "HF_DATASETS_CACHE", cache)
        yield SimpleNamespace(**modules)


@pytest.fixture(scope="module")
def paired(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A dataset of a task of a user's own, collected and paired."""
    folder = tmp_path_factory.mktemp("paired")
    config = CollectConfig(episodes=6, max_steps=40, start="task", hold_s=(0.1, 0.4))
    collect(TASK, config, seed=0, out=folder / "collect", progress=silent)
    pair(TASK, dataset=folder / "collect", out=folder / "pair")
    return Dataset.open(folder / "pair")


def opened(lerobot: SimpleNamespace, root: Path) -> Any:
    return lerobot.lerobot_dataset.LeRobotDataset("a/b", root=root, video_backend="pyav")


def test_every_frame_is_one_that_lerobot_would_record(lerobot: SimpleNamespace, paired: Dataset) -> None:
    features = opened(lerobot, paired.root).meta.features
    for episode in paired.episodes():
        for step in range(len(episode)):
            frame = {name: np.atleast_1d(values[step]) for name, values in episode.columns.items()}
            frame["episode_uid"] = np.array([episode.uid])
            lerobot.feature_utils.validate_frame({**frame, "task": "drive"}, features)
    frame["action"] = frame["action"].astype(np.float64)
    with pytest.raises(ValueError, match="float64"):
        lerobot.feature_utils.validate_frame({**frame, "task": "drive"}, features)


def test_statistics_are_those_that_lerobot_computes_anew(
    lerobot: SimpleNamespace, paired: Dataset, tmp_path: Path
) -> None:
    shutil.copytree(paired.root, tmp_path / "copy")
    ours = json.loads((tmp_path / "copy/meta/stats.json").read_text())
    lerobot.dataset_tools.recompute_stats(opened(lerobot, tmp_path / "copy"))
    theirs = json.loads((tmp_path / "copy/meta/stats.json").read_text())
    assert ours.keys() == theirs.keys()
    for name, stats in theirs.items():
        assert stats.keys() == ours[name].keys(), name
        for key in ("min", "max", "mean", "count"):
            np.testing.assert_allclose(ours[name][key], stats[key], rtol=1e-5, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(ours[name]["std"], stats["std"], rtol=1e-4, atol=1e-5, err_msg=name)
