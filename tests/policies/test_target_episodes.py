import pytest
import torch
from small_cart import TASK

from astra_data.core.errors import BadInputError
from astra_data.policies.episodes import Act, in_target
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


@pytest.mark.parametrize("task", [TASK, TASKS["nao-navigation"], TASKS["humanoid-walker2d"]])
def test_only_the_ant_has_legs_of_several_lengths(task: Task) -> None:
    expected = rf"leg_scale: the robot of {task.name} has one length of legs: expected 1, got 1\.25"
    with pytest.raises(BadInputError, match=expected):
        in_target(task, lambda goal: driving(0.9), 1, seed=3, leg_scale=1.25)
