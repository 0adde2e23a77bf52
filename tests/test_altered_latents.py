from dataclasses import replace

import torch
from altered_latents import ALTERATIONS, AlteredLatents, in_target, of_another

from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.training.running_policy import RunningPolicy
from astra_data.worlds.registry import TASKS

TASK = TASKS["antmaze-umaze"]


def test_each_robot_is_given_the_latent_of_another_anew_at_every_call() -> None:
    latent = torch.arange(6.0)[:, None].expand(6, 3)
    torch.manual_seed(0)
    shuffles = [of_another(latent)[:, 0] for _ in range(50)]
    for shuffled in shuffles:
        assert sorted(shuffled.tolist()) == [*range(6)]
        assert (shuffled != latent[:, 0]).all()
    assert len({tuple(shuffled.tolist()) for shuffled in shuffles}) > 20


@torch.no_grad()
def deployed(latents: bool = True) -> RunningPolicy:
    torch.manual_seed(0)
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8)) if latents else None
    policy = ActorCritic(ActorCriticShape(observation_size=16 if latents else 8, action_size=2))
    for layer in policy.actor.parameters():
        layer.mul_(10)
    return RunningPolicy(TASK, policy, model, None, command_limit=0.3)


@torch.no_grad()
def test_latents_are_altered_where_the_policy_sees_them_alone() -> None:
    """Own latents change nothing, others do; encoders go on with what the robots did."""
    plain = deployed()
    state, goal = torch.randn(5, 4, 29), torch.randn(4, 2)

    def acted(policy: RunningPolicy, inside: bool) -> tuple[torch.Tensor, torch.Tensor]:
        policy.start(4)
        act = policy.act_in_simulator if inside else policy.act
        seen = TASK.abstraction(state) if inside else state
        return torch.stack([act(one, goal) for one in seen]), policy.memory.encoder

    for inside in (False, True):
        own, hidden = acted(plain, inside)
        same, _ = acted(AlteredLatents.of(plain, ALTERATIONS["own"]), inside)
        assert torch.equal(own, same)
        for kind in ("another's", "zeros"):
            altered, going_on = acted(AlteredLatents.of(plain, ALTERATIONS[kind]), inside)
            assert not torch.allclose(own, altered, atol=1e-3)
            assert hidden.shape == going_on.shape and going_on.abs().max() > 0
        first, _ = acted(AlteredLatents.of(plain, lambda latent: latent[[0, 0, 0, 0]]), inside)
        torch.testing.assert_close(first[:, 0], own[:, 0])  # the first robot's own is its own


def test_a_policy_without_latents_has_none_to_alter() -> None:
    plain = deployed(latents=False)
    altered = AlteredLatents.of(plain, ALTERATIONS["zeros"])
    for policy in (plain, altered):
        policy.start(2)
    state, goal = torch.randn(2, 29), torch.randn(2, 2)
    assert torch.equal(plain.act(state, goal), altered.act(state, goal))


def test_episodes_in_the_target_are_those_of_the_seed() -> None:
    policy = deployed()
    policy.task = replace(TASK, objective=replace(TASK.objective, horizon=4))
    first, again, other = (in_target(policy, 3, seed, num_threads=1) for seed in (1, 1, 2))
    assert first.position.shape == (3, 5, 2) and first.success == [0.0] * 3
    assert torch.equal(first.position, again.position)
    assert not torch.equal(first.position, other.position)
