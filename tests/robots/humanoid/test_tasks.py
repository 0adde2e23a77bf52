import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import fmean, stdev

import numpy as np
import pytest
import torch
from html_pages import read_page
from humanoid_recipe import RECIPE
from quick_runs import run_here
from safetensors.torch import load_file
from torch.nn import functional

from astra_data.core.errors import BadInputError
from astra_data.core.progress import silent
from astra_data.dataset.columns import GOAL, SUCCESS
from astra_data.dataset.reader import Dataset
from astra_data.grounding.files import load_history_model
from astra_data.pipeline.stages.augment import AugmentConfig, augment
from astra_data.pipeline.stages.collect import CollectConfig, collect
from astra_data.pipeline.stages.evaluate import EvaluateConfig, evaluate
from astra_data.pipeline.stages.pair import PairConfig, pair
from astra_data.pipeline.stages.train import train
from astra_data.policies.networks import SoftActor
from astra_data.policies.running_policy import PolicyFile
from astra_data.policies.train import PpoTrainConfig
from astra_data.robots.humanoid.model import STANDING
from astra_data.robots.humanoid.tasks import HUMANOID_TASKS
from astra_data.robots.registry import TASKS
from astra_data.worlds.task import Task

SAC_RECIPE = """
task = "humanoid-walker2d"
methods = ["direct_transfer", "domain_randomization", "astra", "iql", "direct_transfer_iql", "full_obs"]
seeds = [0]

[collect]
episodes = 8
max_steps = 40
start = "task"
hold_s = [0.03, 0.2]

[ground]
updates = 5
batch_windows = 4
window = 20
latent_size = 8
held_out_share = 0.25

[train]
learner = "sac"
num_envs = 8
rollout_steps = 16
total_steps = 256
updates_per_step = 1
batch_size = 8
window = 4
burn_in = 1
hidden_sizes = [8]
memory_size = 8
tries = 1

[target]
num_envs = 4
total_steps = 128

[iql]
critic_updates = 3
policy_updates = 3

[align]
updates = 5
batch_windows = 4
window = 20

[evaluate]
episodes = 2

"""
LASTING = "humanoid-short"
HORIZON = 12
"""Steps after which none has fallen yet."""


@pytest.mark.parametrize(
    "quaternion", [(0.9, 0.2, 0.3, 0.1), (1.0, 0.0, 0.0, 1.0)], ids=["ahead", "to the left"]
)
@pytest.mark.parametrize("task", HUMANOID_TASKS, ids=lambda task: task.name)
def test_phi_and_what_is_beyond_it_lose_only_the_place(
    task: Task, quaternion: tuple[float, float, float, float]
) -> None:
    generator = torch.Generator().manual_seed(0)
    state = torch.tensor(STANDING) + 0.03 * torch.randn(47, generator=generator)
    state[3:7] = functional.normalize(torch.tensor(quaternion), dim=0)
    changed = state + 1e-2 * torch.eye(47)
    changed[:, 3:7] = functional.normalize(changed[:, 3:7], dim=-1)

    def known(states: torch.Tensor) -> torch.Tensor:
        return torch.cat([task.abstraction(states), task.beyond(states)], dim=-1)

    kept = (known(changed) - known(state)).abs().amax(-1) > 1e-3
    assert kept.tolist() == [False] * 2 + [True] * 45


@pytest.mark.usefixtures("quick_failures")
def test_a_recipe_runs_whole(tmp_path: Path) -> None:
    (tmp_path / "toy.toml").write_text(RECIPE)
    folder = run_here(tmp_path / "toy.toml")
    results = json.loads((folder / "report" / "results.json").read_text())
    assert results["rows"] == ["direct_transfer", "nas", "astra"]
    assert not (folder / "report" / "trajectories.png").exists()
    dataset = Dataset.open(folder / "pair" / "seed_0")
    assert GOAL not in dataset.features
    for method in ("nas", "astra"):
        model = load_history_model(folder / "ground" / method / "seed_0" / "grounding.safetensors")
        assert (model.shape.goal_size, model.shape.position_octaves) == (0, 0)
        gap = json.loads((folder / "ground" / method / "seed_0" / "gap.json").read_text())
        assert gap["raw"].keys() == TASKS["humanoid-walker2d"].quantities.keys()
    evaluation = json.loads((folder / "evaluate" / "astra" / "seed_0" / "evaluation.json").read_text())
    for world in ("target", "simulated", "raw"):
        assert all(1 < steps < 1000 for steps in evaluation[world]["steps"])
        assert evaluation[world]["failed"] == [1.0] * 3
    states = load_file(folder / "evaluate" / "astra" / "seed_0" / "trajectories.safetensors")["target.state"]
    assert states.shape == (evaluation["target"]["steps"][0] + 1, 47)
    assert states[-2, 2] > 1.0 >= states[-1, 2]
    check_page(folder)


@pytest.mark.usefixtures("quick_failures")
def test_a_recipe_with_sac_runs(tmp_path: Path) -> None:
    (tmp_path / "toy.toml").write_text(SAC_RECIPE)
    folder = run_here(tmp_path / "toy.toml", until="evaluate")
    for method, remembers, observed, steps in (
        ("direct_transfer", True, "abstract", 256),
        ("domain_randomization", True, "abstract", 256),
        ("astra", False, "abstract", 256),
        ("direct_transfer_iql", True, "abstract", 6),
        ("full_obs", True, "full", 128),
    ):
        made = folder / "train" / method / "seed_0"
        trained = PolicyFile.load(made / "policy.safetensors")
        assert isinstance(trained.policy, SoftActor)
        assert (trained.policy.memory is not None, trained.observed) == (remembers, observed)
        assert json.loads((made / "curve.json").read_text())["points"][-1]["steps"] == steps
    initial, tuned = (
        PolicyFile.load(folder / "train" / method / "seed_0" / "policy.safetensors").policy.state_dict()
        for method in ("direct_transfer", "direct_transfer_iql")
    )
    assert not all(torch.equal(initial[name], tuned[name]) for name in initial)


def check_page(folder: Path) -> None:
    """Work out the page's figures from the evaluations."""
    page = read_page((folder / "report" / "results.html").read_text())
    head, *lines = next(table for table in page.tables.values() if "in its simulator" in table[0])
    encoders = page.table("The same policy with the simulator's encoder")
    table = {line[0]: dict(zip(head, line, strict=True)) for line in lines}
    for method, title in (
        ("direct_transfer", "Direct transfer (floor)"),
        ("nas", "NAS"),
        ("astra", "ASTRA"),
    ):
        files = [folder / "evaluate" / method / f"seed_{seed}" / "evaluation.json" for seed in (0, 1)]
        told = [json.loads(file.read_text()) for file in files]
        steps = [fmean(seed["target"]["steps"]) for seed in told]
        returns = [fmean(seed["target"]["return"]) for seed in told]
        simulated = [fmean(seed["simulated"]["steps"]) for seed in told]
        assert table[title]["survived steps in the target"] == f"{fmean(steps):.0f} ± {stdev(steps):.0f}"
        assert table[title]["return in the target"] == f"{fmean(returns):.1f} ± {stdev(returns):.1f}"
        assert table[title]["in its simulator"] == f"{fmean(simulated):.0f} ± {stdev(simulated):.0f}"
        assert table[title]["lost"] == f"{round(fmean(simulated) - fmean(steps)) + 0.0:.0f}"
        assert (table[title]["failed"], table[title]["seeds"]) == ("1.00 ± 0.00", "2")
        # Of two seeds there is no interval.
        assert table[title]["95 % interval"] == "-"
        if method == "astra":
            for encoder in ("source", "target"):
                means = [seed["encoders"][encoder]["steps"] for seed in told]
                of = [line for line in encoders if line[:2] == ["ASTRA", encoder]]
                assert [line[2] for line in of] == [f"{fmean(means):.0f} ± {stdev(means):.0f}"]
    for figure in ("steps", "return", "learning"):
        assert (folder / "report" / f"{figure}.png").exists()
    assert not (folder / "report" / "success.png").exists()


@pytest.fixture
def lasting() -> Iterator[None]:
    usual = TASKS["humanoid-kinematics"]
    TASKS[LASTING] = replace(usual, name=LASTING, objective=replace(usual.objective, horizon=HORIZON))
    yield
    del TASKS[LASTING]


def recorded(out: Path, max_steps: int) -> Path:
    config = CollectConfig(episodes=3, max_steps=max_steps, start="task", hold_s=(0.03, 0.2))
    return collect(LASTING, config, seed=0, out=out, progress=silent, num_threads=1)


@pytest.mark.usefixtures("lasting")
def test_who_lasts_to_the_horizon_succeeds_everywhere(tmp_path: Path) -> None:
    early = Dataset.open(recorded(tmp_path / "early", HORIZON - 1))
    late = Dataset.open(recorded(tmp_path / "late", HORIZON))
    assert early.metadata["success"] == [False] * 3
    for episode in late.episodes():
        np.testing.assert_array_equal(episode.columns[SUCCESS], np.arange(HORIZON) == HORIZON - 1)
    paired = pair(LASTING, PairConfig(), dataset=tmp_path / "late", out=tmp_path / "paired", progress=silent)
    config = PpoTrainConfig(num_envs=4, rollout_steps=8, total_steps=64, hidden_sizes=(8,), memory_size=8)
    train(
        *(LASTING, "direct_transfer", config),
        dataset=paired,
        grounding=None,
        out=tmp_path / "policy",
        device="cpu",
        seed=0,
        progress=silent,
    )
    curve = json.loads((tmp_path / "policy" / "curve.json").read_text())
    assert {point["success"] for point in curve["points"]} == {None}
    assert 0 < curve["points"][0]["episode_steps"] <= HORIZON
    evaluate(
        *(LASTING, "direct_transfer", EvaluateConfig(episodes=2)),
        policy=tmp_path / "policy",
        grounding=None,
        target_encoder=None,
        seed=0,
        out=tmp_path / "evaluated",
        progress=silent,
        num_threads=1,
    )
    evaluation = json.loads((tmp_path / "evaluated" / "evaluation.json").read_text())
    for world in ("target", "simulated", "raw"):
        assert evaluation[world]["success"] == [1.0, 1.0]
        assert evaluation[world]["steps"] == [HORIZON, HORIZON]


@pytest.mark.usefixtures("lasting")
def test_its_episodes_are_not_augmented(tmp_path: Path) -> None:
    dataset = recorded(tmp_path / "dataset", 3)
    with pytest.raises(BadInputError, match="expected a task in a maze"):
        augment(None, AugmentConfig(), dataset=dataset, seed=0, out=tmp_path / "more", progress=silent)
