"""Every learner on a GPU, where there is one."""

import json
from pathlib import Path

import pytest
import torch
from quick_runs import fit_quickly, run_here

from astra_data.policies.running_policy import PolicyFile

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")

ROWS = (
    *("direct_transfer", "domain_randomization", "compass", "rma"),
    *("behavior_cloning", "iql", "direct_transfer_iql"),
    *("nas", "astra", "astra_without_latent", "astra_plus", "target", "full_obs"),
)
PPO = """
[train]
num_envs = 8
rollout_steps = 8
total_steps = 256
hidden_sizes = [16]
memory_size = 8
"""
SAC = """
[train]
learner = "sac"
num_envs = 8
total_steps = 256
updates_per_step = 1
batch_size = 16
window = 8
burn_in = 2
hidden_sizes = [16]
memory_size = 8
"""
REST = """
[collect]
episodes = 8
max_steps = 60
[ground]
updates = 3
batch_windows = 4
window = 20
latent_size = 16
held_out_share = 0.25
[align]
updates = 3
batch_windows = 4
window = 20
held_out_share = 0.25
"""
TABLES = """
[target]
total_steps = 256
[rma]
adaptation_steps = 128
"""
IQL = """
critic_updates = 3
policy_updates = 3
batch_windows = 4
window = 10
burn_in = 2
"""


def make(place: Path, rows: tuple[str, ...], settings: str) -> Path:
    """Make the policies of `rows` on the GPU; return the run's folder."""
    place.mkdir()
    path = place / "small.toml"
    path.write_text(f'task = "antmaze-umaze"\nmethods = {json.dumps(rows)}\nseeds = [0]\n{settings}{REST}')
    with pytest.MonkeyPatch.context() as patch:
        fit_quickly(patch)
        return run_here(path, "align", device="cuda")


@pytest.mark.parametrize(
    ("rows", "settings"),
    [(ROWS, f"{PPO}{TABLES}[iql]{IQL}"), (("direct_transfer", "nas", "astra"), SAC)],
    ids=["ppo", "sac"],
)
def test_each_row_learns_there_and_acts_here(tmp_path: Path, rows: tuple[str, ...], settings: str) -> None:
    folder = make(tmp_path / "run", rows, settings)
    for row in rows:
        made = folder / "train" / row / "seed_0"
        policy = PolicyFile.load(made / "policy.safetensors").policy
        assert {values.device.type for values in policy.parameters()} == {"cpu"}
        told = json.loads((made / "curve.json").read_text())
        assert told["machine"]["gpu"] == torch.cuda.get_device_name()


def test_the_same_seed_gives_the_same_bytes_there(tmp_path: Path) -> None:
    first, again = (make(tmp_path / name, ("nas", "astra_plus"), PPO) for name in ("first", "again"))
    made = sorted(file.relative_to(first) for file in first.rglob("*.safetensors"))
    assert {file.parts[0] for file in made} == {"ground", "train", "align"}
    for file in made:
        assert (first / file).read_bytes() == (again / file).read_bytes(), file
