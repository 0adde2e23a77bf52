"""The other side runs on our datasets: lerobot's command lines and its training.

lerobot takes seconds to load, so all its commands run once before the tests, in forks of one process.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from fake_dataset import COLUMNS, assert_same, fake_episodes, write_fake

from astra_data.dataset.columns import GOAL, Column
from astra_data.dataset.doctor.check import check
from astra_data.dataset.doctor.repair import repair
from astra_data.dataset.reader import Dataset

COMMANDS = Path(__file__).parents[1] / "commands.py"
LOADED = [f"lerobot.scripts.lerobot_{name}" for name in ("train", "edit_dataset")]
TRAINING_STEPS = 2


class Runs(NamedTuple):
    """The dataset, the folder of everything that was made from it, and each command's (exit code, output)."""

    dataset: Dataset
    folder: Path
    results: dict[str, tuple[int, str]]


def write_with_goal(root: Path) -> Dataset:
    goal = Column(GOAL, size=2, names=("x", "y"), meaning="where to go")
    goals = {one.uid: np.tile(np.array([one.uid % 7, 1], np.float32), (len(one), 1)) for one in fake_episodes()}
    episodes = (replace(one, columns={**one.columns, GOAL: goals[one.uid]}) for one in fake_episodes())
    return write_fake(root, episodes, columns=[*COLUMNS, goal])


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folder = tmp_path_factory.mktemp("lerobot")
    dataset = write_with_goal(folder / "set")
    at = [f"--root={dataset.root}"]
    edit = ["lerobot-edit-dataset", "--repo_id=a/b", *at]
    commands = {
        "delete": [
            *edit,
            "--operation.type=delete_episodes",
            "--operation.episode_indices=[1,3]",
            "--new_repo_id=a/c",
            f"--new_root={folder / 'deleted'}",
        ],
        "train": [
            *["lerobot-train", "--dataset.repo_id=a/b", f"--dataset.root={dataset.root}"],
            *["--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--wandb.enable=false"],
            *["--policy.dim_model=16", "--policy.n_heads=2", "--policy.dim_feedforward=16"],
            *["--policy.chunk_size=4", "--policy.n_action_steps=4", "--policy.use_vae=false"],
            *["--num_workers=0", "--batch_size=4", f"--steps={TRAINING_STEPS}", "--log_freq=1"],
            *["--save_checkpoint=false", f"--output_dir={folder / 'training'}"],
        ],
    }
    settings = {
        "HF_HUB_OFFLINE": "1",
        "HF_DATASETS_OFFLINE": "1",
        "HF_HOME": str(folder / "home"),
        "OMP_NUM_THREADS": "1",
        "PYTHONWARNINGS": "ignore",
    }
    done = subprocess.run(
        [sys.executable, COMMANDS],
        input=json.dumps({"modules": LOADED, "commands": commands}),
        env=os.environ | settings,
        capture_output=True,
        text=True,
        check=True,
    )
    results = {name: (code, shown) for name, (code, shown, _) in json.loads(done.stdout).items()}
    return Runs(dataset, folder, results)


def assert_succeeded(runs: Runs, name: str) -> str:
    code, output = runs.results[name]
    assert code == 0, output
    return output


def test_our_metadata_is_joined_again_after_lerobot_deleted_episodes(runs: Runs, tmp_path: Path) -> None:
    assert_succeeded(runs, "delete")
    edited = runs.folder / "deleted"
    assert check(edited).faults == []
    assert repair(edited, out=tmp_path / "set", like=runs.dataset).episodes == 3
    joined = Dataset.open(tmp_path / "set")
    assert joined.verify() == []
    kept = [episode for number, episode in enumerate(runs.dataset.episodes()) if number not in (1, 3)]
    assert_same(joined.episodes(), kept)
    assert joined.schema == runs.dataset.schema and joined.description["parents"] == [runs.dataset.identity]


def test_lerobot_trains_act_on_it(runs: Runs) -> None:
    assert f"step:{TRAINING_STEPS}" in assert_succeeded(runs, "train").replace(" ", "")
