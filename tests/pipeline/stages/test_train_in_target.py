import json
from pathlib import Path
from unittest.mock import MagicMock

import pytest
import torch
from small_run import TRAIN
from stopping import Stopped, stop_past

from astra_data.core.progress import Progress, silent
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.pipeline.stages.evaluate import EvaluateConfig, evaluate
from astra_data.pipeline.stages.train import train
from astra_data.policies.episodes import ObservedTargetEnv
from astra_data.policies.running_policy import PolicyFile
from astra_data.policies.train import TargetConfig
from astra_data.robots.registry import TASKS

CONFIG = TRAIN.model_copy(update={"data_start_share": 0.5, "episode_steps": 1})
MEMORY = {"target": None, "full_obs": 0}
"""Sizes of the policies' memories; None is the recipe's."""


def make(task: str, row: str, dataset: Path, out: Path, progress: Progress = silent) -> bytes:
    settings = TargetConfig(num_envs=4, total_steps=4 * 8 * 6, memory_size=MEMORY[row])
    train(task, row, CONFIG, settings=settings, dataset=dataset, out=out, progress=progress, num_threads=1)
    return (out / "policy.safetensors").read_bytes()


@pytest.mark.parametrize(("row", "observed", "size"), [("target", "abstract", 8), ("full_obs", "full", 33)])
def test_the_upper_bounds_learn_in_the_target_and_go_on_after_an_interruption(
    task: str, paired: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, row: str, observed: str, size: int
) -> None:
    monkeypatch.setattr("astra_data.core.checkpoint.CHECKPOINT_SECONDS", 0.0)
    built = MagicMock(side_effect=ObservedTargetEnv)
    monkeypatch.setattr("astra_data.policies.train.ObservedTargetEnv", built)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    expected = make(task, row, paired, whole)
    with pytest.raises(Stopped):
        make(task, row, paired, broken, stop_past(0.7))
    episodes, options = PairedEpisodes.load(paired), dict(built.call_args.kwargs)
    starts = options.pop("starts")
    assert torch.equal(starts[0], episodes.steps(episodes.target_state))
    assert torch.equal(starts[1], episodes.steps(episodes.windows.goal))
    assert built.call_args.args == (TASKS[task], 4)
    assert options == {"observed": observed, "data_start_share": 0.5, "device": "cpu", "num_threads": 1}
    seen: list[float] = []
    assert make(task, row, paired, broken, lambda done, note: seen.append(done)) == expected
    assert seen == pytest.approx([5 / 6, 1.0])
    points = json.loads((whole / "curve.json").read_text())["points"]
    assert max(point["episode_steps"] or 0 for point in points) > 1  # the task's, not the simulated one
    trained = PolicyFile.load(whole / "policy.safetensors")
    assert trained.simulation is None and trained.observed == observed
    assert trained.policy.shape.observation_size == size
    assert trained.policy.shape.memory_size == (CONFIG.memory_size if MEMORY[row] is None else 0)
    evaluate(task, row, EvaluateConfig(episodes=2), policy=whole, out=tmp_path / "evaluated", num_threads=1)
    assert (tmp_path / "evaluated" / "evaluation.json").is_file()
