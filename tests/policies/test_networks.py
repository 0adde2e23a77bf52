from dataclasses import asdict

import pytest
import torch
from torch import Tensor

from astra_data.policies import networks

OBSERVATION, ACTION = torch.randn(3, 5, 4), torch.randn(3, 5, 2)


def policies(memory_size: int) -> list[networks.Policy]:
    torch.manual_seed(0)
    sizes = {"observation_size": 4, "action_size": 2, "memory_size": memory_size, "embedding_size": 7}
    return [networks.ActorCritic(networks.PolicyShape(**sizes)), networks.SoftActor(networks.PolicyShape(**sizes))]  # type: ignore[arg-type]


def steps(policy: networks.Policy, hidden: Tensor) -> Tensor:
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


def test_means_are_clipped_and_keep_the_gradient_of_what_is_not() -> None:
    output = torch.tensor([-7.0, -0.4, 0.9, 3.0], requires_grad=True)
    mean = networks.bounded(output)
    torch.testing.assert_close(mean, torch.tensor([-1.0, -0.4, 0.9, 1.0]))
    mean.sum().backward()
    assert output.grad is not None and torch.equal(output.grad, torch.ones(4))
    policy, seen = networks.ActorCritic(networks.PolicyShape(3, 2)), 1e3 * torch.randn(50, 3)
    clipped, std = policy.policy(seen)
    torch.testing.assert_close(clipped, policy.actor(seen).clamp(-1.0, 1.0))
    torch.testing.assert_close(std, torch.full((50, 2), -0.5).exp())
    assert policy.value(seen).shape == (50,)


@pytest.mark.parametrize("index", [0, 1])
def test_the_likeliest_action_is_taken_unless_one_is_drawn(index: int) -> None:
    policy = policies(0)[index]
    features = torch.randn(1, 4).expand(20_000, 4)
    location, scale = (values[0].detach() for values in policy.policy(features))
    likeliest, drawn = policy.act(features), policy.act(features, torch.Generator().manual_seed(0))
    assert drawn.abs().max() <= 1.0
    if isinstance(policy, networks.SoftActor):
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
        if isinstance(policy, networks.SoftActor):
            tanh = torch.distributions.TanhTransform()
            distribution = torch.distributions.TransformedDistribution(normal, tanh)
        expected = distribution.log_prob(action).sum(-1)
        torch.testing.assert_close(policy.log_prob(OBSERVATION, action), expected, atol=1e-4, rtol=1e-4)
        for bound in (1.0, -1.0):
            assert policy.log_prob(OBSERVATION, torch.full((3, 5, 2), bound)).isfinite().all()
        if isinstance(policy, networks.SoftActor):
            drawn, density = policy.sample(OBSERVATION)
            torch.testing.assert_close(density, policy.log_prob(OBSERVATION, drawn), atol=1e-3, rtol=1e-3)
            for parameter in [*policy.actor.parameters()][-2:]:
                parameter.requires_grad_(False).zero_()
            torch.testing.assert_close(policy.policy(OBSERVATION)[1], torch.full((3, 5, 2), 1.001))
        elif isinstance(policy, networks.ActorCritic):
            weights = ([*network.parameters()][-2].detach() for network in (policy.actor, policy.critic))
            sizes = [float(weight.norm(dim=1).max()) for weight in weights]
            assert sizes == pytest.approx([0.01, 1.0], rel=1e-3)


SHAPE = networks.AdaptiveShape(3, 2, memory_size=8, hidden_sizes=(16,), extrinsics_size=4, history_length=45)


@torch.no_grad()
def test_features_are_those_of_an_actor_critic_and_the_extrinsics() -> None:
    torch.manual_seed(0)
    teacher, observed = networks.Teacher(SHAPE, parameter_count=6), torch.randn(5, 9, 3 + 6)
    student, plain = (
        networks.Student.of_teacher(teacher),
        networks.ActorCritic(networks.PolicyShape(3, 2, memory_size=8)),
    )
    assert plain.memory is not None and teacher.memory is not None
    plain.memory.load_state_dict(teacher.memory.state_dict())
    action, start = torch.randn(5, 9, 2), torch.zeros(5, 9)
    start[2, 4] = 1.0
    features = teacher.remember_sequence(observed, action, torch.zeros(5, 8), start)
    remembered = plain.remember_sequence(observed[..., :3], action, torch.zeros(5, 8), start)
    torch.testing.assert_close(features, torch.cat([remembered, teacher.extrinsics(observed)], dim=-1))
    assert teacher.extrinsics(observed).shape == (5, 9, 4)
    alone, _ = teacher.remember(observed[:, 0], action[:, 0], torch.zeros(5, 8))
    torch.testing.assert_close(alone, features[:, 0])
    hidden = student.initial_hidden(5)
    seen, hidden = student.remember(observed[:, 0, :3], action[:, 0], hidden)
    torch.testing.assert_close(seen[:, :11], remembered[:, 0])
    assert torch.equal(hidden[:, -5:], torch.cat([observed[:, 0, :3], action[:, 0]], dim=-1))
    assert torch.equal(seen[:, 11:], student.adaptation(hidden[:, 8:]))


@torch.no_grad()
def test_a_teachers_extrinsics_depend_on_the_parameters_alone() -> None:
    torch.manual_seed(0)
    teacher, observed = networks.Teacher(SHAPE, parameter_count=6), torch.randn(5, 9)
    elsewhere = torch.cat([torch.randn(5, 3), observed[:, 3:]], dim=1)
    assert torch.equal(teacher.extrinsics(elsewhere), teacher.extrinsics(observed))
    assert (teacher.extrinsics(observed[:, [0, 1, 2, 8, 7, 6, 5, 4, 3]]) - teacher.extrinsics(observed)).any()


@torch.no_grad()
def test_a_student_acts_like_its_teacher_where_it_estimates_well_and_holds_nothing_of_the_encoder() -> None:
    torch.manual_seed(0)
    teacher = networks.Teacher(SHAPE, parameter_count=6)
    teacher.log_std.fill_(-1.5)
    student = networks.Student.of_teacher(teacher)
    features = torch.randn(5, 3 + 8 + 4)
    for one, other in zip(student.policy(features), teacher.policy(features), strict=True):
        assert torch.equal(one, other)
    assert torch.equal(student.value(features), teacher.value(features)) and asdict(student.shape) == asdict(SHAPE)
    assert not any(name.startswith("encoder") for name in student.state_dict())
    learned = {name.split(".")[0] for name, value in student.named_parameters() if value.requires_grad}
    assert learned == {"adaptation"}


@torch.no_grad()
def test_a_history_is_convolved_along_time() -> None:
    """The order of what a row is embedded as has no meaning."""
    torch.manual_seed(0)
    made, history, order = networks.HistoryEstimate(5, 45, 4), torch.randn(6, 45 * 5), torch.randperm(32)
    estimate, first = made(history), made.convolutions.get_parameter("0.weight")
    for values in (made.embedding.weight, made.embedding.bias, first.transpose(0, 1)):
        values.copy_(values[order])
    torch.testing.assert_close(made(history), estimate)
