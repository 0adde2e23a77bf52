import pytest
import torch
from toy_worlds import Slope, assert_resumes, train

from astra_data.core.seeding import derive
from astra_data.methods.rma import Adaptation, RmaConfig
from astra_data.policies.networks import AdaptiveShape, Student, Teacher

HISTORY = 40


class Shown(Teacher):
    """A teacher whose extrinsics are the parameter itself, and its reverse."""

    def extrinsics(self, told: torch.Tensor) -> torch.Tensor:
        return torch.cat([told[..., 1:], -told[..., 1:]], dim=-1)


def begin(num_envs: int, iterations: int) -> Adaptation:
    torch.manual_seed(0)
    shape = AdaptiveShape(1, 1, hidden_sizes=(8,), extrinsics_size=2, history_length=HISTORY)
    config = RmaConfig(
        extrinsics_size=2,
        history_length=HISTORY,
        adaptation_steps=iterations * 16 * num_envs,
        adaptation_learning_rate=3e-3,
    )
    world = Slope(num_envs)
    return Adaptation(world, Shown(shape, 1), config, rollout_steps=16, horizon=100, seed=1)


@torch.no_grad()
def correlation(student: Student, *, shuffled: bool) -> float:
    """Return that of estimated and true parameters after a full history; `shuffled` is that of other rows."""
    torch.manual_seed(5)
    world, count = Slope(256), 256
    told, previous, hidden = world.reset(), torch.zeros(count, 1), student.initial_hidden(count)
    for _ in range(HISTORY):
        features, hidden = student.remember(told[:, :1], previous, hidden)
        previous, _ = student.policy(features)
        told = world.step(previous).observation
    estimate = student.adaptation(hidden.roll(1, dims=0) if shuffled else hidden)
    return float(torch.corrcoef(torch.stack([estimate[:, 0], told[:, 1]]))[0, 1])


def test_a_student_recovers_what_its_history_shows() -> None:
    learner = begin(64, 15)
    untrained = abs(correlation(learner.student, shuffled=False))
    points = train(learner)
    assert correlation(learner.student, shuffled=False) > 0.9 > untrained
    assert abs(correlation(learner.student, shuffled=True)) < 0.3
    assert points[0]["r2_extrinsics"] < 0.25 < 0.5 < points[-1]["r2_extrinsics"] <= 1.0
    assert points[-1].keys() == {"success", "episode_steps", "episodes", "reward", "r2_extrinsics"}


def test_the_student_acts_and_only_its_estimate_learns() -> None:
    """Actions are those of the deployed student, computed here from scratch."""
    learner = begin(4, 2)
    acted: list[torch.Tensor] = []
    world = learner.env
    step = world.step
    world.step = lambda action: (acted.append(action.clone()), step(action))[1]  # type: ignore[method-assign, func-returns-value]
    before = {name: value.clone() for name, value in learner.student.state_dict().items()}
    first_told, first_hidden = learner.observation.clone(), learner.hidden.clone()
    with torch.no_grad():
        features, _ = learner.student.remember(first_told[:, :1], torch.zeros(4, 1), first_hidden)
        expected, _ = learner.student.policy(features)
    learner.iterate()
    assert torch.equal(acted[0], expected)
    changed = {
        name.split(".")[0]
        for name, value in learner.student.state_dict().items()
        if not torch.equal(value, before[name])
    }
    assert changed == {"adaptation"}
    learner.iterate()
    assert learner._optimizer.param_groups[0]["lr"] == pytest.approx(1.5e-3)  # after half of the steps
    assert learner._seed == derive(1, "adaptation")


def test_resuming_gives_the_same_parameters_to_the_bit() -> None:
    assert_resumes(lambda: begin(4, 4), "student")
