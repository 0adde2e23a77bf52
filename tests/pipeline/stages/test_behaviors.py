from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from small_cart import TASK as CART
from small_cart import Last
from stopping import Stopped, stop_past
from torch import Tensor

from astra_data.core.progress import silent
from astra_data.core.seeding import derive
from astra_data.dataset.columns import ACTION, DONE, SUCCESS, TERMINATED, TRUNCATED, Episode
from astra_data.pipeline.stages import collect as suboptimal
from astra_data.pipeline.stages.collect import (
    RandomCommands,
    StressCommands,
    clearance,
    record,
    suboptimal_by_ppo,
    suboptimal_by_sac,
)
from astra_data.policies.networks import ActorCritic, SoftActor
from astra_data.policies.ppo import PpoConfig
from astra_data.policies.sac import SacConfig
from astra_data.robots.registry import TASKS, task_named
from astra_data.worlds.task import Task

TASK = task_named("nao-navigation")
HOLD = (3, 16)
STARTS = torch.tensor([[-1.5, 2.0], [0.0, 2.0], [1.5, 1.0], [0.0, 0.0]])
"""Middles of corridors of the maze, which are 1 m wide."""


def believed(position: Tensor) -> Tensor:
    state = torch.zeros(len(position), 29)
    state[:, :2] = position
    return state


def nearest(behavior: RandomCommands) -> float:
    """Return the least clearance in m of robots that do exactly as they are told for a minute."""
    simulator = TASK.simulator(len(STARTS))
    simulator.reset_to(torch.cat([STARTS, torch.zeros_like(STARTS)], dim=-1))
    act, least = behavior.begin(len(STARTS), seed=0), np.inf
    for _ in range(310):
        action = act(believed(simulator.state[:, :2]), torch.zeros(len(STARTS), 2))
        position = simulator.step(action)[:, :2].double().numpy()
        least = min(least, TASK.maze.clearance(position).min())
    return least


def test_a_watch_foresees_the_clearance_of_a_second() -> None:
    toward, along = [0.0, 1.0], [1.0, 0.0]
    least = clearance(TASK, believed(STARTS[1:2]), np.array([[toward, along]]))
    # 0.25 m/s for five steps of 0.192 s, on a grid of 0.05 m.
    assert least.shape == (1, 2) and least[0] == pytest.approx([0.5 - 0.24, 0.5], abs=0.051)


def test_commands_that_are_watched_keep_clear_of_walls() -> None:
    assert nearest(RandomCommands(TASK, HOLD)) < 0.2
    assert nearest(RandomCommands(TASK, HOLD, 0.25)) >= 0.25 - 1e-6


def test_a_robot_that_is_too_near_is_led_away() -> None:
    act = RandomCommands(TASK, HOLD, 0.3).begin(64, seed=0)
    near = torch.tensor([[0.0, 2.35]]).expand(64, 2)
    assert float(act(believed(near), torch.zeros(64, 2))[:, 1].max()) < 0.0


def test_commands_are_held_and_repeat_with_the_seed() -> None:
    state = believed(torch.zeros(5, 2))
    first, second = (RandomCommands(TASK, (4, 4)).begin(5, seed=1) for _ in range(2))
    commands = torch.stack([first(state, state[:, :2]) for _ in range(8)])
    assert torch.equal(commands, torch.stack([second(state, state[:, :2]) for _ in range(8)]))
    assert torch.equal(commands[:1].expand(4, 5, 2), commands[:4]) and not torch.equal(commands[3], commands[4])


def test_stress_commands_are_at_the_bounds_and_half_of_them_reverse_the_one_before() -> None:
    act = StressCommands(TASKS["nao-kick"], (1, 1)).begin(200, seed=0)
    commands = torch.stack([act(torch.zeros(200, 47), torch.zeros(200, 0)) for _ in range(20)])
    assert torch.allclose(commands.abs().amax(-1), torch.ones(20, 200)) and (commands[0] != 0).all()
    is_reversed = (commands[1:] == -commands[:-1]).all(-1)
    assert 0.45 < float(is_reversed.float().mean()) < 0.55
    new = commands[1:][~is_reversed]
    assert float(new.mean(0).abs().max()) < 0.1
    assert float((new.abs() == 1).float().mean()) == pytest.approx(1 / 3, abs=0.01)


def test_where_it_is_to_last_an_episode_succeeds_in_its_last_step() -> None:
    task, recorded = replace(CART, objective=Last(horizon=4)), list[Episode]()
    env, still = task.target(2, seed=0), torch.full((2, 1), -0.6)  # 0 m/s
    env.reset()
    writer: Any = SimpleNamespace(staged=set(), add=lambda episode, number: recorded.append(episode))
    assert record(task, env, lambda *_: still, range(2), writer, max_steps=4, seed=0, progress=silent) == 8
    for episode in recorded:
        assert episode.columns[SUCCESS].tolist() == [False, False, False, True]
        assert episode.columns[ACTION].tolist() == pytest.approx([0.0] * 4, abs=1e-6)  # in m/s
        assert (episode.metadata["success"], episode.metadata["failed"]) == (True, False)
    assert len(recorded) == 2


def test_an_episode_that_ends_in_its_last_step_is_terminated_and_not_truncated() -> None:
    ends = torch.tensor([True, False])
    env: Any = SimpleNamespace(
        state=torch.zeros(2, 3),
        goal=torch.zeros(2, 2),
        step=lambda action, active: SimpleNamespace(
            reward=torch.zeros(2), terminated=ends.clone(), success=torch.zeros(2, dtype=torch.bool)
        ),
    )
    still = torch.zeros(2, CART.action.size)
    recorded = dict[int, Episode]()
    writer: Any = SimpleNamespace(staged=set(), add=lambda episode, number: recorded.update({number: episode}))
    assert record(CART, env, lambda *_: still, range(2), writer, max_steps=2, seed=0, progress=silent) == 3
    assert [recorded[0].columns[name].tolist() for name in (TERMINATED, TRUNCATED, DONE)] == [[True], [False], [True]]
    assert [recorded[1].columns[name].tolist() for name in (TERMINATED, TRUNCATED)] == [[False] * 2, [False, True]]
    assert recorded[1].columns[DONE].tolist() == [False, True]
    ends.fill_(True)
    record(CART, env, lambda *_: still, range(2), writer, max_steps=1, seed=0, progress=silent)
    assert [recorded[1].columns[name].tolist() for name in (TERMINATED, TRUNCATED, DONE)] == [[True], [False], [True]]


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
    assert [one.went_on_from for one in Counting.made] == [0, 100] and Counting.made[-1].goes_on == episodes_go_on
    assert metadata["trained_steps"] == 300
    suboptimal_by_ppo(task, **given, progress=silent)  # what is finished is not trained again
    assert Counting.made[-1].steps == Counting.made[-1].went_on_from == 300


@pytest.mark.parametrize(("lasting", "steps", "trained"), [((10, 20, 60), 10_000, 300), ((10, 20, 30, 40), 350, 400)])
def test_sac_stops_once_episodes_last_or_after_its_steps(
    lasting: tuple[int, ...], steps: int, trained: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int] = []

    def lasts(task: Task, begin: object, episodes: int, seed: int, **_: object) -> Any:
        seeds.append(seed)
        return SimpleNamespace(steps=[lasting[len(seeds) - 1]] * episodes)

    monkeypatch.setattr(suboptimal, "in_target", lasts)
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
    trials = (derive(3, f"trial {100 * (count + 1)}") for count in range(len(seeds)))
    assert shares[-1] == 1.0 and seeds == [derive(trial, "starts") for trial in trials]
    assert type(policy.policy) is SoftActor and policy.observed == "full"
    config = Counting.made[0].config
    assert isinstance(config, SacConfig) and (config.total_steps, config.discount) == (steps, 0.99)
