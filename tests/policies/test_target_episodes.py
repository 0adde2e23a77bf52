from dataclasses import replace

import pytest
import torch
from small_cart import TASK, Cart, Last
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.policies.episodes import Act, RecordedRange, in_target
from astra_data.robots.registry import TASKS
from astra_data.worlds.task import Task


def driving(speed: float) -> Act:
    """Return actions of a speed in m/s, of commands from -1 to 4."""
    return lambda state, goal: torch.full_like(goal, (speed - 1.5) / 2.5)


def test_episodes_end_in_success_in_failure_or_with_their_time() -> None:
    there = in_target(TASK, lambda goal: driving(0.9), 5, seed=3).outcome
    assert there.success == [1.0] * 5 and there.failed == [0.0] * 5
    tipped = in_target(TASK, lambda goal: driving(3.5), 5, seed=3)
    assert tipped.outcome.failed == [1.0] * 5 and tipped.outcome.steps == [1] * 5
    late = in_target(TASK, lambda goal: driving(-0.5), 5, seed=3)
    assert late.outcome.success == [0.0] * 5 and late.outcome.steps == [TASK.objective.horizon] * 5
    assert late.filmed.shape == (TASK.objective.horizon + 1, 2) and tipped.filmed.shape == (2, 2)
    assert late.rate > 0


def test_commands_beyond_the_recorded_are_of_robots_that_still_drive() -> None:
    """One episode ends at its goal; the others go on, at a speed that was recorded."""
    goals: list[Tensor] = []

    def begin(goal: Tensor) -> Act:
        goals.append(goal.clone())
        fastest = (goal == goal.min()).float()
        return lambda state, goal: ((0.9 * fastest - 0.5 * (1 - fastest)) - 1.5) / 2.5

    asked = RecordedRange(torch.tensor([-1.0]), torch.tensor([0.8]), TASK.limits)
    found = in_target(TASK, begin, 3, seed=3, asked=asked).outcome
    short = min(found.steps)
    assert sum(found.success) == 1.0 and short < TASK.objective.horizon
    assert asked.share == pytest.approx(short / sum(found.steps))


def test_where_it_is_to_last_an_episode_succeeds_in_its_last_step() -> None:
    lasting = replace(TASK, objective=Last(horizon=6))
    found = in_target(lasting, lambda goal: driving(0.0), 3, seed=3).outcome
    assert found.success == [1.0] * 3 and found.steps == [6] * 3


def test_the_first_robot_is_filmed_until_its_episode_ends() -> None:
    first = torch.tensor([[1.0], [0.0]])
    speed = 0.9 * first - 0.5 * (1 - first)
    found = in_target(TASK, lambda goal: lambda state, goal: (speed - 1.5) / 2.5, 2, seed=3)
    assert found.outcome.steps[0] < found.outcome.steps[1] == TASK.objective.horizon
    assert len(found.filmed) == found.outcome.steps[0] + 1


def test_goals_are_told_and_each_robot_is_built_and_started_once() -> None:
    goals: list[Tensor] = []

    def begin(goal: Tensor) -> Act:
        goals.append(goal.clone())
        return driving(0.9)

    found = in_target(replace(TASK, robot=Unseeded), begin, 3, seed=3)
    assert torch.equal(found.start_goal["goal"], goals[0])
    assert Unseeded.made == Unseeded.began == 3


class Unseeded(Cart):
    """A robot that counts how often it is built and started."""

    made = 0
    began = 0

    def __init__(self) -> None:
        type(self).made += 1

    def reset(self) -> list[float]:
        type(self).began += 1
        return super().reset()


def test_starts_and_goals_depend_on_the_seed_alone() -> None:
    goals: list[Tensor] = []

    def begin(goal: Tensor) -> Act:
        goals.append(goal.clone())
        return driving(0.9)

    for seed in (3, 3, 4):
        in_target(TASK, begin, 5, seed)
    assert torch.equal(goals[0], goals[1]) and not torch.equal(goals[0], goals[2])


def test_progress_is_told_by_the_horizon() -> None:
    told: list[float] = []
    in_target(TASK, lambda goal: driving(-0.5), 2, 0, progress=lambda done, note: told.append(done))
    assert len(told) == TASK.objective.horizon and told[-1] == pytest.approx(0.99)


@pytest.mark.parametrize("task", [TASK, TASKS["nao-navigation"], TASKS["humanoid-walker2d"]])
def test_only_the_ant_has_legs_of_several_lengths(task: Task) -> None:
    expected = rf"leg_scale: the robot of {task.name} has one length of legs: expected 1, got 1\.25"
    with pytest.raises(BadInputError, match=expected):
        in_target(task, lambda goal: driving(0.9), 1, seed=3, leg_scale=1.25)


class Apart(Cart):
    """A robot that begins a meter behind the one that was built before."""

    made = 0

    def __init__(self) -> None:
        self.behind = float(type(self).made)
        type(self).made += 1

    def reset(self) -> list[float]:
        super().reset()
        self.x = -self.behind
        return [self.x, self.speed]


def test_the_film_begins_where_the_first_robot_does() -> None:
    found = in_target(replace(TASK, robot=Apart), lambda goal: driving(0.9), 3, seed=3)
    assert Apart.made == 3
    assert found.filmed[:2, 0].tolist() == pytest.approx([0.0, 0.081])
