"""With learners that only count: what stops a training, what it goes on from, and what is recorded of it."""

from pathlib import Path
from typing import Any

import pytest
import torch
from small_cart import TASK as CART
from stopping import Stopped, stop_past
from torch import Tensor

from astra_data.core.progress import silent
from astra_data.core.seeding import derive
from astra_data.policies import collecting as suboptimal
from astra_data.policies.collecting import suboptimal_by_ppo, suboptimal_by_sac
from astra_data.policies.networks import ActorCritic, SoftActor
from astra_data.policies.ppo import PpoConfig
from astra_data.policies.sac import SacConfig
from astra_data.robots.registry import TASKS
from astra_data.worlds.task import Task

MAZE, WALKER = TASKS["antmaze-umaze"], TASKS["humanoid-kinematics"]


class Counting:
    """Stands for PPO and SAC: 100 steps per iteration, and nothing is learned."""

    made: list["Counting"] = []  # noqa: RUF012 - of all tests, emptied by the fixture

    def __init__(self, env: Any, policy: Any, config: Any, *, horizon: int, seed: int) -> None:
        self.env, self.policy, self.config, self.horizon, self.seed = env, policy, config, horizon, seed
        self.steps, self.went_on_from, self.goes_on = 0, 0, True
        self.made.append(self)

    def iterate(self) -> dict[str, float]:
        self.steps += 100
        return {"reward": 0.25}

    def state_dict(self) -> dict[str, Tensor]:
        return {"steps": torch.tensor(self.steps)}

    def load_state_dict(self, state: dict[str, Tensor], observation: Tensor, *, goes_on: bool) -> None:
        self.steps = self.went_on_from = int(state["steps"])
        self.goes_on = goes_on


@pytest.fixture(autouse=True)
def counting(monkeypatch: pytest.MonkeyPatch) -> None:
    Counting.made = []
    for name in ("Ppo", "Sac"):
        monkeypatch.setattr(suboptimal, name, Counting)
    for name in ("_PPO_ENVS", "_SAC_ENVS"):
        monkeypatch.setattr(suboptimal, name, 2)


def test_ppo_stops_after_its_steps(tmp_path: Path) -> None:
    shares: list[float] = []
    notes: list[str] = []

    def progress(share: float, note: str) -> None:
        shares.append(share)
        notes.append(note)

    trained, metadata = suboptimal_by_ppo(MAZE, steps=250, seed=7, folder=tmp_path, num_threads=1, progress=progress)
    (ppo,) = Counting.made
    assert shares == pytest.approx([0.4, 0.8, 1.0]) and notes[0].endswith("reward per step 0.250")
    assert (ppo.horizon, ppo.seed, ppo.config) == (MAZE.objective.horizon, 7, PpoConfig(total_steps=250))
    assert type(trained.policy) is ActorCritic and trained.policy.memory is None
    assert (trained.observed, trained.simulation, trained.dataset) == ("abstract", None, None)
    assert trained.policy.shape.observation_size == 8
    assert not any(parameter.requires_grad for parameter in trained.policy.parameters())
    assert metadata["trained_steps"] == 300 and metadata["learner"]["num_envs"] == 2
    assert metadata["learner"]["hidden_sizes"] == [64, 64] and metadata["learner"]["total_steps"] == 250
    assert metadata["spent"].keys() == {"wall_seconds", "cpu_seconds", "finished_at"}


@pytest.mark.parametrize(("task", "episodes_go_on"), [(MAZE, True), (CART, False)])
def test_it_goes_on_from_its_checkpoint(
    task: Task, episodes_go_on: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.core.checkpoint.CHECKPOINT_SECONDS", 0.0)

    given: dict[str, Any] = {"steps": 250, "seed": 7, "folder": tmp_path, "num_threads": 1}
    with pytest.raises(Stopped):
        suboptimal_by_ppo(task, **given, progress=stop_past(0.7))
    _, metadata = suboptimal_by_ppo(task, **given, progress=silent)
    assert [one.went_on_from for one in Counting.made] == [0, 100]
    assert Counting.made[-1].goes_on == episodes_go_on and metadata["trained_steps"] == 300
    # What is finished is not trained again.
    suboptimal_by_ppo(task, **given, progress=silent)
    assert Counting.made[-1].steps == Counting.made[-1].went_on_from == 300


@pytest.mark.parametrize(("lasting", "steps", "trained"), [((10, 20, 60), 10_000, 300), ((10, 20, 30, 40), 350, 400)])
def test_sac_stops_once_episodes_last_or_after_its_steps(
    lasting: tuple[int, ...], steps: int, trained: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int] = []

    def lasts(deployed: Any, seed: int, num_threads: int | None) -> float:
        seeds.append(seed)
        return float(lasting[len(seeds) - 1])

    monkeypatch.setattr(suboptimal, "_lasts", lasts)
    shares: list[float] = []
    policy, metadata = suboptimal_by_sac(
        WALKER,
        steps=steps,
        episode_steps=50,
        seed=3,
        folder=tmp_path,
        num_threads=1,
        progress=lambda share, note: shares.append(share),
    )
    assert metadata["trained_steps"] == trained and shares[0] == pytest.approx(max(100 / steps, 10 / 50))
    assert shares[-1] == 1.0
    assert seeds == [derive(3, f"trial {100 * (count + 1)}") for count in range(len(seeds))]
    assert type(policy.policy) is SoftActor and policy.observed == "full"
    config = Counting.made[0].config
    assert isinstance(config, SacConfig) and (config.total_steps, config.discount) == (steps, 0.99)
