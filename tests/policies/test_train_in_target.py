from pathlib import Path
from typing import Any

import pytest
import torch
from toy_episodes import toy_episodes

from astra_data.core.progress import silent
from astra_data.grounding.simulator import NO_GROUNDING
from astra_data.policies import train as train_in_target
from astra_data.policies.train import InTarget, PpoTrainConfig, TargetConfig, Training
from astra_data.robots.registry import TASKS

TASK = TASKS["antmaze-umaze"]
TRAIN = PpoTrainConfig(num_envs=3, total_steps=999, memory_size=7, data_start_share=0.25, episode_steps=5, discount=0.9)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Let nothing be trained; return what was asked for."""
    seen: dict[str, Any] = {}

    def build(*given: object, **options: object) -> str:
        seen["world"] = given, options
        return "world"

    def train(*given: object) -> tuple[str, dict[str, Any]]:
        seen["train"] = given
        return "policy", {"points": []}

    monkeypatch.setattr(train_in_target, "ObservedTargetEnv", build)
    monkeypatch.setattr(train_in_target, "train_in", train)
    return seen


def training(folder: Path, settings: TargetConfig | None) -> Training:
    state = torch.randn(2, 4, 4)
    mask = torch.ones(2, 4)
    mask[1, 2:] = 0.0
    target, goal = torch.arange(8.0).reshape(2, 4, 1).expand(2, 4, 29), torch.randn(2, 4, 2)
    episodes = toy_episodes(state, torch.zeros(2, 4, 2), next_state=state, mask=mask, target_state=target, goal=goal)
    return Training(TASK, TRAIN, settings, episodes, NO_GROUNDING, None, 0, "cpu", folder, silent, 2)


@pytest.mark.parametrize("observed", ["abstract", "full"])
def test_settings_for_the_target_are_laid_over_those_of_the_training(
    observed: Any, asked: dict[str, Any], tmp_path: Path
) -> None:
    given = training(tmp_path, TargetConfig(num_envs=2, memory_size=0))
    trained, curve = InTarget(observed)(given)
    world, config, memory_size, same, horizon = asked["train"]
    assert (world, memory_size, same, curve) == ("world", 0, given, {"points": []})
    assert config == TRAIN.model_copy(update={"num_envs": 2, "memory_size": 0})
    assert horizon == TASK.objective.horizon  # not the simulated one
    (task, count), options = asked["world"]
    assert (task, count) == (TASK, 2)
    starts = options.pop("starts")
    assert options == {"observed": observed, "data_start_share": 0.25, "device": "cpu", "num_threads": 2}
    assert starts[0][:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert torch.equal(starts[1], given.episodes.steps(given.episodes.windows.goal))
    assert (trained.simulation, trained.observed) == (None, observed) and str(trained.policy) == "policy"
    assert (trained.dataset, trained.content_hash) == ("toy@data-1.0.0", "0")
