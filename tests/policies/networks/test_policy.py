import pytest
import torch
from torch import Tensor

from astra_data.policies.networks import (
    ActorCritic,
    ActorCriticShape,
    Policy,
    PolicyShape,
    SoftActor,
    bounded,
    features_of,
)

OBSERVATION, ACTION = torch.randn(3, 5, 4), torch.randn(3, 5, 2)


def policies(memory_size: int) -> list[Policy]:
    torch.manual_seed(0)
    sizes = {"observation_size": 4, "action_size": 2, "memory_size": memory_size, "embedding_size": 7}
    return [ActorCritic(ActorCriticShape(**sizes)), SoftActor(PolicyShape(**sizes))]  # type: ignore[arg-type]


def steps(policy: Policy, hidden: Tensor) -> Tensor:
    features = []
    for step in range(5):
        seen, hidden = policy.remember(OBSERVATION[:, step], ACTION[:, step], hidden)
        features.append(seen)
    return torch.stack(features, dim=1)


@pytest.mark.parametrize("memory_size", [0, 6])
def test_a_sequence_is_remembered_as_step_by_step(memory_size: int) -> None:
    for policy in policies(memory_size):
        hidden = policy.initial_hidden(3)
        assert hidden.shape == (3, memory_size) and not hidden.any()
        sequence = policy.remember_sequence(OBSERVATION, ACTION, hidden, torch.zeros(3, 5))
        torch.testing.assert_close(sequence, steps(policy, hidden))


def test_a_start_empties_the_memory_of_its_row() -> None:
    memory = policies(6)[0].memory
    start = torch.zeros(3, 5)
    start[1, 2] = 1.0
    known, other = torch.randn(2, 3, 6)
    ours, theirs = (features_of(memory, OBSERVATION, ACTION, hidden, start) for hidden in (known, other))
    torch.testing.assert_close(ours[1, 2:], theirs[1, 2:])
    assert not torch.allclose(ours[1, :2], theirs[1, :2])
    assert not torch.allclose(ours[0], theirs[0])
    assert torch.equal(features_of(None, OBSERVATION, ACTION, known, start), OBSERVATION)


def test_means_are_clipped_and_keep_the_gradient_of_what_is_not() -> None:
    output = torch.tensor([-7.0, -0.4, 0.9, 3.0], requires_grad=True)
    mean = bounded(output)
    torch.testing.assert_close(mean, torch.tensor([-1.0, -0.4, 0.9, 1.0]))
    mean.sum().backward()
    assert output.grad is not None and torch.equal(output.grad, torch.ones(4))
    policy, seen = ActorCritic(ActorCriticShape(3, 2, initial_log_std=-1.0)), 1e3 * torch.randn(50, 3)
    clipped, std = policy.policy(seen)
    torch.testing.assert_close(clipped, policy.actor(seen).clamp(-1.0, 1.0))
    torch.testing.assert_close(std, torch.full((50, 2), -1.0).exp())
    assert policy.value(seen).shape == (50,)


@pytest.mark.parametrize("index", [0, 1])
def test_the_likeliest_action_is_taken_unless_one_is_drawn(index: int) -> None:
    policy = policies(0)[index]
    features = torch.randn(1, 4).expand(20_000, 4)
    location, scale = (values[0].detach() for values in policy.policy(features))
    likeliest, drawn = policy.act(features), policy.act(features, torch.Generator().manual_seed(0))
    assert drawn.abs().max() <= 1.0
    if policy.squashes:
        torch.testing.assert_close(likeliest[0], torch.tanh(location))
        drawn = torch.atanh(drawn.double().clamp(-1 + 1e-7, 1 - 1e-7)).float()
    else:
        torch.testing.assert_close(likeliest[0], location)
        inner = torch.distributions.Normal(location, scale).sample((100_000,)).clamp(-1.0, 1.0)
        torch.testing.assert_close(drawn.std(0), inner.std(0), rtol=0.03, atol=0)
        return
    torch.testing.assert_close(drawn.mean(0), location, atol=0.03, rtol=0)
    torch.testing.assert_close(drawn.std(0), scale, rtol=0.03, atol=0)


def test_the_density_of_an_action_is_that_of_its_distribution() -> None:
    action = torch.rand(3, 5, 2) * 1.8 - 0.9
    for policy in policies(0):
        normal = torch.distributions.Normal(*policy.policy(OBSERVATION))
        distribution: torch.distributions.Distribution = normal
        if policy.squashes:
            tanh = torch.distributions.TanhTransform()
            distribution = torch.distributions.TransformedDistribution(normal, tanh)
        expected = distribution.log_prob(action).sum(-1)
        torch.testing.assert_close(policy.log_prob(OBSERVATION, action), expected, atol=1e-4, rtol=1e-4)


def test_the_bounds_of_actions_have_a_density() -> None:
    for policy in policies(0):
        assert policy.log_prob(OBSERVATION, torch.ones(3, 5, 2)).isfinite().all()
        assert policy.log_prob(OBSERVATION, -torch.ones(3, 5, 2)).isfinite().all()
