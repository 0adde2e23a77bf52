import json
from pathlib import Path

import pytest
import torch

from astra_data.deployment.folder import deploy
from astra_data.policies.networks import ActorCritic, PolicyShape
from astra_data.policies.running_policy import PolicyFile

TASK = f"{Path(__file__).parents[2] / 'small_cart.py'}:TASK"


@pytest.fixture(scope="package")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a user's own cart, with a lively policy that has a memory; deployed beside it."""
    run = tmp_path_factory.mktemp("runs") / "rail"
    folder = run / "train/direct_transfer/seed_0"
    folder.mkdir(parents=True)
    torch.manual_seed(0)
    policy = ActorCritic(PolicyShape(2, 1, hidden_sizes=(8,), memory_size=4))
    with torch.no_grad():
        for weight in policy.actor[-1].parameters():
            weight.mul_(50)
    PolicyFile(policy, None, "drives", "0" * 64).save(folder / "policy.safetensors")
    (run / "recipe.json").write_text(json.dumps({"task": TASK}))
    deploy(run, "direct_transfer", run.with_name("policy"))
    return run
