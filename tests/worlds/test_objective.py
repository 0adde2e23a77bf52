from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.robots.nao.kicking import Kicking
from astra_data.worlds.objective import RETURN, SUCCESS, SURVIVED_STEPS, Objective
from astra_data.worlds.plane.mazes import FIELD, U_MAZE
from astra_data.worlds.plane.navigation import Navigation

TRUE_FALSE = torch.tensor([True, True, False, False])
FALSE_TRUE = torch.tensor([False, True, False, True])


@dataclass(frozen=True)
class Balance(Objective):
    """Keep a number small: as little as an objective can be."""

    action_size = 1

    def draw_starts(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        return rng.normal(size=(count, 1))

    def reached(self, state: Tensor, goal: Tensor) -> Tensor:
        return state[:, 0] == 0

    def reward(self, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
        return -after[:, 0].abs()


@dataclass(frozen=True)
class LastingBalance(Balance):
    is_lasting = True


def test_a_goal_succeeds_when_it_is_reached() -> None:
    plain = Balance(horizon=3)
    for step in (1, 2, 3, 4):
        assert torch.equal(plain.succeeded(TRUE_FALSE, FALSE_TRUE, step), TRUE_FALSE)
    assert plain.scores == (SUCCESS,)


def test_who_is_to_last_succeeds_at_the_horizon_without_a_failure() -> None:
    lasting = LastingBalance(horizon=3)
    assert torch.equal(lasting.succeeded(TRUE_FALSE, FALSE_TRUE, 2), TRUE_FALSE)
    assert torch.equal(lasting.succeeded(TRUE_FALSE, FALSE_TRUE, 3), ~FALSE_TRUE)
    assert torch.equal(lasting.succeeded(TRUE_FALSE, FALSE_TRUE, 4), ~FALSE_TRUE)
    assert lasting.scores == (SURVIVED_STEPS, RETURN)


PLANAR: dict[str, Any] = {"navigation": Navigation(U_MAZE, horizon=9), "kicking": Kicking(FIELD, horizon=9)}


@pytest.mark.parametrize("objective", PLANAR.values(), ids=PLANAR)
def test_a_speed_limit_shortens_and_does_not_turn(objective: Objective) -> None:
    action = torch.zeros(4, objective.action_size)
    action[:, :2] = torch.tensor([[0.6, 0.8], [3.0, -4.0], [0.03, 0.04], [0.0, 0.0]])
    limited = objective.limit_command(action, 0.5)[:, :2]
    half = 0.5 * 0.5**0.5  # ±1 along each axis comes before the limit
    expected = torch.tensor([[0.3, 0.4], [half, -half], [0.03, 0.04], [0.0, 0.0]])
    torch.testing.assert_close(limited, expected)
    assert torch.equal(objective.limit_command(action[:1], 2.0), action[:1])
    assert not objective.limit_command(action, 0.0)[:, :2].any()
