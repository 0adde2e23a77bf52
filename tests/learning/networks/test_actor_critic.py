import torch

from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape, bounded


def test_remembering_step_by_step_is_remembering_the_sequence() -> None:
    torch.manual_seed(0)
    policy = ActorCritic(ActorCriticShape(observation_size=3, action_size=2, memory_size=8))
    observation, action = torch.randn(4, 12, 3), torch.randn(4, 12, 2)
    start = torch.zeros(4, 12)
    start[0, 5] = start[1, 0] = start[1, 11] = start[2, 5] = start[2, 6] = 1.0
    first = torch.randn(4, 8)
    features = policy.remember_sequence(observation, action, first, start)
    hidden = first
    for step in range(12):
        new = start[:, step].bool()
        hidden = torch.where(new[:, None], policy.initial_hidden(4), hidden)
        seen, hidden = policy.remember(observation[:, step], action[:, step], hidden)
        torch.testing.assert_close(features[:, step], seen)
    # Nothing from before a start is left.
    other = policy.remember_sequence(observation, action, torch.randn(4, 8), start)
    torch.testing.assert_close(other[0, 5:], features[0, 5:])
    assert (other[0, :5] - features[0, :5]).abs().max() > 1e-3
    assert (other[3] - features[3]).abs().max() > 1e-3


def test_without_memory_the_features_are_the_observation() -> None:
    policy = ActorCritic(ActorCriticShape(observation_size=3, action_size=2))
    observation = torch.randn(4, 12, 3)
    features = policy.remember_sequence(
        observation, torch.zeros(4, 12, 2), policy.initial_hidden(4), torch.ones(4, 12)
    )
    assert torch.equal(features, observation)
    assert policy.initial_hidden(4).shape == (4, 0)


def test_means_are_bounded_and_the_deviation_is_as_asked() -> None:
    policy = ActorCritic(ActorCriticShape(observation_size=3, action_size=2, initial_log_std=-1.0))
    mean, std = policy.policy(1e6 * torch.randn(50, 3))
    assert mean.abs().max() <= 1.0
    torch.testing.assert_close(std, torch.full((50, 2), -1.0).exp())
    assert policy.value(torch.randn(5, 3)).shape == (5,)


def test_a_clipped_mean_keeps_the_gradient_of_what_is_not() -> None:
    output = torch.tensor([-7.0, -0.4, 0.9, 3.0], requires_grad=True)
    mean = bounded(output, clips=True)
    torch.testing.assert_close(mean, torch.tensor([-1.0, -0.4, 0.9, 1.0]))
    mean.sum().backward()
    assert output.grad is not None and torch.equal(output.grad, torch.ones(4))
    torch.testing.assert_close(bounded(output, clips=False), output.tanh())
    shape = ActorCriticShape(observation_size=3, action_size=2, clips_mean=True)
    policy, seen = ActorCritic(shape), 1e3 * torch.randn(50, 3)
    torch.testing.assert_close(policy.policy(seen)[0], policy.actor(seen).clamp(-1.0, 1.0))
