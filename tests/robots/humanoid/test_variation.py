"""Domain randomization, COMPASS and RMA on the humanoid's tasks."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from humanoid_recipe import RECIPE
from quick_runs import run_here
from stopping import Stopped, stop_past

from astra_data.core.progress import Progress, silent
from astra_data.pipeline.stages.collect import CollectConfig, collect
from astra_data.pipeline.stages.pair import PairConfig, pair
from astra_data.pipeline.stages.train import train
from astra_data.policies.rma import RmaConfig
from astra_data.policies.running_policy import PolicyFile
from astra_data.policies.train import PpoTrainConfig
from astra_data.robots.humanoid.tasks import HUMANOID_TASKS, RANDOMIZED_ACTIONS, WIDE_RANGES
from astra_data.robots.registry import TASKS
from astra_data.worlds.variation import JointVariation

HEAD = """
task = "humanoid-walker2d"
methods = ["domain_randomization", "compass"]
seeds = [0]

"""
TASK = "humanoid-short"


def test_the_ranges_are_those_printed_in_the_paper() -> None:
    printed = {
        "friction": (0.8, 1.2),
        "action_scale": (-0.05, 0.05),
        "action_noise": (0.05, 0.05),
        "observation_scale": (0.9, 1.1),
        "timestep_scale": (0.015 / 0.015, 0.025 / 0.015),
    }
    for task in HUMANOID_TASKS:
        assert task.varied.wide.model_dump() == printed
        of_actions = {name: printed[name] for name in ("action_scale", "action_noise")}
        assert task.varied.randomized == JointVariation(**of_actions)


def test_a_recipe_runs_whole(tmp_path: Path) -> None:
    (tmp_path / "toy.toml").write_text(HEAD + RECIPE[RECIPE.index("[collect]") :])
    folder = run_here(tmp_path / "toy.toml")
    results = json.loads((folder / "report" / "results.json").read_text())
    assert results["rows"] == ["domain_randomization", "compass"]
    drawn = {
        "domain_randomization": RANDOMIZED_ACTIONS,
        "compass": WIDE_RANGES,
    }
    for method, variation in drawn.items():
        trained = PolicyFile.load(folder / "train" / method / "seed_0" / "policy.safetensors")
        assert trained.simulation is not None and trained.simulation.variation == variation
    for method in ("domain_randomization", "compass"):
        evaluation = json.loads((folder / "evaluate" / method / "seed_0" / "evaluation.json").read_text())
        for world in ("target", "simulated", "raw"):
            assert all(1 < steps < 1000 for steps in evaluation[world]["steps"])
            assert evaluation[world]["failed"] == [1.0] * 3


@pytest.fixture
def short() -> Iterator[None]:
    usual = TASKS["humanoid-extended"]
    TASKS[TASK] = replace(usual, name=TASK, objective=replace(usual.objective, horizon=12))
    yield
    del TASKS[TASK]


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("method", ["compass", "rma"])
def test_training_goes_on_after_an_interruption(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.core.checkpoint.CHECKPOINT_SECONDS", 0.0)
    config = CollectConfig(episodes=3, max_steps=9, start="task", hold_s=(0.03, 0.2))
    collected = collect(TASK, config, seed=0, out=tmp_path / "raw", progress=silent, num_threads=1)
    paired = pair(TASK, PairConfig(), dataset=collected, out=tmp_path / "paired", progress=silent)
    settings = RmaConfig(history_length=40, adaptation_steps=64) if method == "rma" else None
    training = PpoTrainConfig(num_envs=4, rollout_steps=8, total_steps=96, hidden_sizes=(8,), memory_size=8)

    def trained(out: Path, progress: Progress = silent) -> bytes:
        given = {"dataset": paired, "grounding": None, "settings": settings, "seed": 0, "device": "cpu"}
        train(TASK, method, training, **given, out=out, progress=progress)  # type: ignore[arg-type]
        return (out / "policy.safetensors").read_bytes()

    expected = trained(tmp_path / "whole")
    with pytest.raises(Stopped):
        trained(tmp_path / "interrupted", stop_past(0.4 / training.tries))
    assert trained(tmp_path / "interrupted") == expected
