import pytest
import torch
from small_cart import TASK
from torch import Tensor

from astra_data.training.own_world import Act
from astra_data.training.target_episodes import in_target


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
