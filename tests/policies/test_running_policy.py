import numpy as np
import pytest
import torch
from small_cart import TASK as RAIL_CART
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.grounding.alignment import TargetEncoder
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.policies.networks import ActorCritic, ActorCriticShape
from astra_data.policies.running_policy import RunningPolicy
from astra_data.policies.simulator_env import policy_observation
from astra_data.robots.registry import TASKS

TASK = TASKS["antmaze-umaze"]
STATE, GOAL = torch.randn(3, 6, 29), torch.randn(3, 2)
GOALS = GOAL[:, None].expand(3, 6, 2)


def run(running: RunningPolicy, *, in_simulator: bool = False) -> Tensor:
    """Return the actions (B, T, A) for the states above, or for φ of them."""
    running.start(3)
    act = running.act_in_simulator if in_simulator else running.act
    states = TASK.abstraction(STATE) if in_simulator else STATE
    return torch.stack([act(states[:, step], GOAL) for step in range(6)], dim=1)


def previous(actions: Tensor) -> Tensor:
    return torch.cat([torch.zeros(3, 1, 2), actions[:, :-1]], dim=1)


@pytest.mark.parametrize(("aligned", "in_simulator"), [(False, False), (True, False), (False, True), (True, True)])
@torch.no_grad()
def test_latents_are_those_of_the_whole_history(aligned: bool, in_simulator: bool) -> None:
    """Only target states are for ψ^t; ψ^s encodes abstract ones, wherever they come from."""
    torch.manual_seed(0)
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    target = TargetEncoder(29, 2, 2, embedding_size=8, latent_size=8)
    policy = ActorCritic(ActorCriticShape(observation_size=16, action_size=2))
    for layer in policy.actor.parameters():
        layer.mul_(10)  # actions of some size
    running = RunningPolicy(TASK, policy, model, target if aligned else None)
    actions = run(running, in_simulator=in_simulator)
    abstract = STATE[..., [0, 1, 15, 16]]
    if aligned and not in_simulator:
        latent, _ = target.encoder(target.encoder_input(STATE, GOALS, previous(actions)))
    else:
        latent, _ = model.encoder(model.encoder_input(abstract, GOALS, previous(actions)))
    observation = policy_observation(TASK.objective, abstract, GOALS, latent)
    torch.testing.assert_close(actions, policy.policy(observation)[0], atol=1e-5, rtol=0)
    assert actions.abs().max() > 0.1
    assert running.observation_size == 16 and RunningPolicy(TASK, policy, observed="full").observation_size == 33


@torch.no_grad()
def test_a_policy_of_the_raw_simulator_remembers_and_forgets_at_the_start() -> None:
    torch.manual_seed(0)
    policy = ActorCritic(ActorCriticShape(observation_size=8, action_size=2, memory_size=8))
    running = RunningPolicy(TASK, policy)
    actions = run(running)
    observation = policy_observation(TASK.objective, STATE[..., [0, 1, 15, 16]], GOALS, None)
    features = policy.remember_sequence(observation, previous(actions), policy.initial_hidden(3), torch.zeros(3, 6))
    torch.testing.assert_close(actions, policy.policy(features)[0], atol=1e-5, rtol=0)
    assert torch.equal(run(running), actions)
    drawn = []
    for seed in (1, 1, 2):
        running.start(3, torch.Generator().manual_seed(seed))
        begun = running.memory
        drawn.append(running.act(STATE[:, 0], GOAL))
    assert torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[0], drawn[2])
    running.resume(begun)
    assert torch.equal(running.act(STATE[:, 0], GOAL), actions[:, 0])


@torch.no_grad()
def test_the_encoder_sees_the_shortened_command_and_the_policy_its_own() -> None:
    torch.manual_seed(0)
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    policy = ActorCritic(ActorCriticShape(observation_size=16, action_size=2, memory_size=8))
    for layer in policy.actor.parameters():
        layer.mul_(20)  # actions of some size
    running = RunningPolicy(TASK, policy, model, command_limit=0.2)
    actions = run(running)
    assert actions.norm(dim=-1).max() <= 0.2 + 1e-6
    abstract = STATE[..., [0, 1, 15, 16]]
    latent, _ = model.encoder(model.encoder_input(abstract, GOALS, previous(actions)))
    observation = policy_observation(TASK.objective, abstract, GOALS, latent)
    hidden, own, outputs = policy.initial_hidden(3), torch.zeros(3, 2), []
    for step in range(6):
        features, hidden = policy.remember(observation[:, step], own, hidden)
        own = policy.act(features)
        outputs.append(own)
    torch.testing.assert_close(
        actions, TASK.objective.limit_command(torch.stack(outputs, dim=1), 0.2), atol=1e-4, rtol=0
    )
    assert torch.stack(outputs).norm(dim=-1).max() > 0.3


def test_states_and_goals_come_as_arrays_too_and_are_looked_at_first() -> None:
    running = RunningPolicy(RAIL_CART, ActorCritic(ActorCriticShape(observation_size=2, action_size=1)))
    state, goal = np.random.default_rng(0).uniform(size=(4, 2)), np.zeros((4, 1))
    with pytest.raises(BadInputError, match=r"expected start\(count\) before the first command"):
        running.command(state, goal)
    running.start(4)
    expected = running.command(torch.tensor(state, dtype=torch.float32), torch.zeros(4, 1))
    assert torch.equal(running.command(state, goal), expected)
    with pytest.raises(BadInputError, match=r"state: expected the shape \(4, 2\), got \(4, 3\)"):
        running.command(np.zeros((4, 3)), goal)
    with pytest.raises(BadInputError, match=r"state: expected the shape \(4, 2\), got \(2,\)"):
        running.command(state[0], goal)
    with pytest.raises(BadInputError, match=r"goal: expected the shape \(4, 1\), got \(4, 0\)"):
        running.command(state, np.zeros((4, 0)))
    state[2, 1] = np.nan
    with pytest.raises(BadInputError, match="state: expected finite values, got nan in row 2, entry 1"):
        running.command(state, goal)
