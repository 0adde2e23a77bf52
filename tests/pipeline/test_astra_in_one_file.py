"""ASTRA in one file computes what the package does, from the same weights and data."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from astra_data import collect, pair
from astra_data.core.seeding import derive
from astra_data.grounding.alignment import TargetEncoder
from astra_data.grounding.encoder import take_scales
from astra_data.grounding.fit import HistoryFit
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights, recorded_rewards
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.pipeline.stages import align
from astra_data.pipeline.stages.collect import CollectConfig
from astra_data.policies.networks import ActorCritic, PolicyShape
from astra_data.policies.ppo import Ppo, PpoConfig
from astra_data.policies.simulator_env import Simulation, WorldConfig, data_starts, training_env
from astra_data.robots.registry import task_named
from astra_data.worlds.user_code import user_object

ROOT = Path(__file__).parents[2]
RAIL = f"{ROOT}/tests/small_cart.py:TASK"
NEAR: dict[str, Any] = {"atol": 1e-6, "rtol": 1e-5}


def of_the_file(name: str) -> Any:
    return user_object(f"{ROOT}/recipes/examples/astra_in_one_file.py:{name}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("rail")
    config = CollectConfig(episodes=8, max_steps=30, start="task", hold_s=(0.1, 0.4))
    collect(RAIL, config, out=made / "collected")
    return pair(RAIL, dataset=made / "collected", out=made / "paired")


@pytest.fixture(scope="module")
def both(folder: Path) -> tuple[Any, ...]:
    """Return the task, both models with the same weights, and what each has read of the dataset."""
    task, episodes = task_named(RAIL), PairedEpisodes.load(folder)
    fit = HistoryFit(latent=True, reward=True, failures=False, scatter=False)
    episodes = fit._rewarded(task, episodes, predicts_failures=False)
    theirs = of_the_file("load_episodes")(folder, task)
    torch.manual_seed(0)
    model = GroundingModel(GroundingShape(1, 1, 1, position_octaves=0))
    for parameter in model.correction[-1].parameters():
        nn.init.normal_(parameter, std=0.05)
    windows = episodes.windows
    correction = episodes.steps(windows.next_state - windows.simulated_next)
    state, goal = episodes.steps(windows.state), episodes.steps(windows.goal)
    take_scales(model, {"state": state, "goal": goal, "correction": correction})
    rewards = recorded_rewards(windows), windows.goes_on, windows.failed
    model.set_reward_scales(*map(episodes.steps, rewards))
    mine = of_the_file("Grounding")(1, 1, 1)
    mine.set_scales(theirs)
    scales = {name: values.clone() for name, values in mine.state_dict().items() if name.endswith(("_mean", "_std"))}
    mine.load_state_dict({**model.state_dict(), **scales}, strict=False)
    for name, values in scales.items():
        torch.testing.assert_close(values, model.state_dict()[name], **NEAR)
    return task, model, mine, episodes, theirs


def test_it_reads_the_same_episodes(both: tuple[Any, ...]) -> None:
    *_, episodes, theirs = both
    same = ("state", "action", "previous_action", "goal", "simulated_next", "next_state", "mask")
    for name in same:
        torch.testing.assert_close(theirs[name], getattr(episodes.windows, name))
    torch.testing.assert_close(*map(episodes.steps, (theirs["reward"], recorded_rewards(episodes.windows))))
    assert torch.equal(theirs["learns_reward"], episodes.windows.goes_on)
    assert torch.equal(theirs["target_state"], episodes.target_state)


def test_losses_and_corrections_are_those_of_the_package(both: tuple[Any, ...]) -> None:
    _, model, mine, episodes, theirs = both
    total, parts = model.losses(episodes.windows, LossWeights())
    found, found_parts = mine.losses(theirs)
    torch.testing.assert_close(found, total, **NEAR)
    torch.testing.assert_close(torch.stack(found_parts), torch.stack([*parts.values()]), **NEAR)
    windows = episodes.windows
    latent, _ = model.encode(windows)
    given = latent, windows.action, windows.simulated_next
    torch.testing.assert_close(mine.correct(*given), model.correct(*given), **NEAR)
    model.shrink_reward(windows)
    mine.shrink_reward(theirs)
    residual = model.target_reward(*given[:2], torch.zeros(()))
    torch.testing.assert_close(mine.predict_residual(*given[:2]), residual, **NEAR)
    assert (model.correct(*given) - windows.simulated_next).abs().max() > 1e-3


def test_the_alignment_losses_are_those_of_the_package(both: tuple[Any, ...]) -> None:
    _, model, mine, episodes, theirs = both
    torch.manual_seed(1)
    encoder = TargetEncoder(2, 1, 1, embedding_size=64, latent_size=64, position_octaves=0)
    target = of_the_file("HistoryModel")(2, 1, 1)
    target.load_state_dict(encoder.state_dict(), strict=False)
    bandwidths = torch.tensor(align._BANDWIDTHS) * 8.0
    expected = align._losses(model, encoder, episodes.windows, episodes.target_state, bandwidths)
    found = [*of_the_file("alignment_losses")(mine, target, theirs)]
    torch.testing.assert_close(torch.stack(found), torch.stack(expected), **NEAR)


def test_the_first_update_of_ppo_is_that_of_the_package(both: tuple[Any, ...]) -> None:
    task, model, mine, episodes, theirs = both
    simulation = Simulation(WorldConfig(reward="predicted", data_start_share=0.5))
    grounding = HistoryGrounding(model)
    starts = data_starts(task, simulation.world, episodes, grounding)
    env = training_env(task, simulation, grounding, num_envs=32, device="cpu", starts=starts)
    torch.manual_seed(2)
    policy = ActorCritic(PolicyShape(env.observation_size, 1))
    torch.manual_seed(2)
    my_policy = of_the_file("ActorCritic")(env.observation_size, 1)
    before = [values.clone() for values in my_policy.state_dict().values()]
    ppo = Ppo(env, policy, PpoConfig(), horizon=40, seed=0)
    torch.manual_seed(derive(0, "first reset"))
    my_ppo = of_the_file("Ppo")(of_the_file("GroundedEnv")(task, mine, theirs, num_envs=32), my_policy)
    figures = ppo.iterate()
    torch.manual_seed(derive(0, "iteration 0"))
    success = my_ppo.iterate()
    assert success == pytest.approx(figures["success"]) and my_ppo.share == pytest.approx(ppo.share)
    moved = 0.0
    for (name, mine_now), first in zip(my_policy.state_dict().items(), before, strict=True):
        expected: Tensor = policy.state_dict()[name]
        torch.testing.assert_close(mine_now, expected, **NEAR)
        moved = max(moved, float((mine_now - first).abs().max()))
    assert moved > 1e-3
