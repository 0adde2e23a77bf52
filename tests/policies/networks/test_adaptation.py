from dataclasses import asdict

import torch

from astra_data.policies.networks import (
    ActorCritic,
    ActorCriticShape,
    AdaptiveShape,
    Student,
    Teacher,
)

SHAPE = AdaptiveShape(3, 2, memory_size=8, hidden_sizes=(16,), extrinsics_size=4, history_length=45)


@torch.no_grad()
def test_features_are_those_of_an_actor_critic_and_the_extrinsics() -> None:
    torch.manual_seed(0)
    teacher, observed = Teacher(SHAPE, parameter_count=6), torch.randn(5, 9, 3 + 6)
    student, plain = Student.of_teacher(teacher), ActorCritic(ActorCriticShape(3, 2, memory_size=8))
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
    assert torch.equal(seen[:, 11:], student.adaptation(hidden[:, 8:]))


@torch.no_grad()
def test_a_teachers_extrinsics_depend_on_the_parameters_alone() -> None:
    torch.manual_seed(0)
    teacher, observed = Teacher(SHAPE, parameter_count=6), torch.randn(5, 9)
    elsewhere = torch.cat([torch.randn(5, 3), observed[:, 3:]], dim=1)
    assert torch.equal(teacher.extrinsics(elsewhere), teacher.extrinsics(observed))
    assert (teacher.extrinsics(observed[:, [0, 1, 2, 8, 7, 6, 5, 4, 3]]) - teacher.extrinsics(observed)).any()


@torch.no_grad()
def test_a_student_acts_like_its_teacher_where_it_estimates_well_and_holds_nothing_of_the_encoder() -> None:
    torch.manual_seed(0)
    teacher = Teacher(SHAPE, parameter_count=6)
    teacher.log_std.fill_(-1.5)
    student = Student.of_teacher(teacher)
    features = torch.randn(5, 3 + 8 + 4)
    for one, other in zip(student.policy(features), teacher.policy(features), strict=True):
        assert torch.equal(one, other)
    assert torch.equal(student.value(features), teacher.value(features))
    assert asdict(student.shape) == asdict(SHAPE)
    assert not any(name.startswith("encoder") for name in student.state_dict())
    learned = {name.split(".")[0] for name, value in student.named_parameters() if value.requires_grad}
    assert learned == {"adaptation"}


@torch.no_grad()
def test_a_student_remembers_a_sequence_as_it_does_step_by_step() -> None:
    torch.manual_seed(0)
    student = Student(SHAPE)
    observation, action = torch.randn(3, 6, 3), torch.randn(3, 6, 2)
    start = torch.zeros(3, 6)
    start[1, 4] = 1.0
    first = torch.randn_like(student.initial_hidden(3))
    features = student.remember_sequence(observation, action, first, start)
    hidden = first
    for step in range(6):
        hidden = torch.where(start[:, step, None] > 0, student.initial_hidden(3), hidden)
        seen, hidden = student.remember(observation[:, step], action[:, step], hidden)
        torch.testing.assert_close(features[:, step], seen)
    other = student.remember_sequence(observation, action, torch.randn_like(first), start)
    torch.testing.assert_close(other[1, 4:], features[1, 4:])
    assert (other[1, :4] - features[1, :4]).abs().max() > 1e-4
