"""Errors about tensors that are not as expected."""

from types import SimpleNamespace
from typing import cast

import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.worlds.objective import Objective
from astra_data.worlds.user_code import expect, expect_same, first, judged, paid

STATE = torch.zeros(3, 2)


def test_a_tensor_that_is_as_expected_is_returned_itself() -> None:
    """Of any length where one is -1."""
    assert expect("step", STATE, (-1, 2), torch.float32) is STATE


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ([[0.0, 0.0]], "step: expected a torch tensor, got a list"),
        (torch.zeros(3), r"step: expected shape \(any, 2\), got \(3,\)"),
        (torch.zeros(3, 4), r"step: expected shape \(any, 2\), got \(3, 4\)"),
        (torch.zeros(3, 2).double(), "step: expected torch.float32, got torch.float64"),
        (torch.tensor([[0.0, 1.0], [float("inf"), 2.0]]), "step: expected finite numbers, got inf"),
        (torch.tensor([[0.0, float("nan")]]), "step: expected finite numbers, got nan"),
    ],
)
def test_anything_else_is_refused_with_what_it_is(found: object, said: str) -> None:
    """One line says what was expected and what came."""
    with pytest.raises(BadInputError, match=f"^{said}"):
        expect("step", found, (-1, 2), torch.float32)


def test_states_are_the_same_but_for_rounding() -> None:
    """The entry that is furthest apart is told."""
    expected = torch.tensor([[1.0, 2.0], [1000.0, 0.0]])
    expect_same("state", expected + torch.tensor([[1e-5, 0.0], [0.05, 9e-5]]), expected)
    with pytest.raises(BadInputError, match=r"^state here: expected 1000 in row 1, entry 0, got 1003$"):
        expect_same("state", expected + torch.tensor([[2.0, 0.0], [3.0, 1.0]]), expected, "here")
    with pytest.raises(BadInputError, match=r"^state: expected shape \(2, 2\), got \(1, 2\)$"):
        expect_same("state", expected[:1], expected)


def test_the_first_value_of_any_shape() -> None:
    """In the order of the last axis."""
    assert first(torch.tensor([[2.0, 3.0], [4.0, 5.0]])) == 2.0


def _objective(**functions: object) -> Objective:
    return cast(Objective, SimpleNamespace(**functions))


def test_an_objective_judges_and_pays_each_state() -> None:
    """Judgements are bools, payments numbers, one per state."""
    objective = _objective(
        reached=lambda state, goal: state[:, 0] >= goal[:, 0],
        reward=lambda before, after, goal, failed: after[:, 0] - before[:, 0],
    )
    goal = torch.tensor([[0.0], [1.0], [-1.0]])
    assert judged(objective, "reached", STATE, goal).tolist() == [True, False, True]
    assert paid(objective, STATE, STATE + 2.0, goal, torch.zeros(3, dtype=torch.bool)).tolist() == [2.0] * 3


def test_an_objective_that_fails_or_returns_something_else_is_named() -> None:
    """With the call that it was asked by."""
    wrong = _objective(reached=lambda state, goal: state[:, 0], reward=lambda *_: torch.zeros(2))
    with pytest.raises(BadInputError, match=r"^objective.reached\(state, goal\): expected torch.bool"):
        judged(wrong, "reached", STATE, STATE)
    with pytest.raises(BadInputError, match=r"^objective.reward\(.*\): expected shape \(3,\), got \(2,\)"):
        paid(wrong, STATE, STATE, STATE, STATE[:, 0] > 0)

    def failing(*_: object) -> None:
        raise KeyError("goal")

    with pytest.raises(BadInputError, match=r"^objective.missed\(state, goal\)"):
        judged(_objective(missed=failing), "missed", STATE, STATE)


def test_answers_come_where_the_states_are() -> None:
    """Else they meet no other tensor of a training on a GPU; "meta" stands for one."""
    there = torch.empty(3, 2, device="meta")
    objective = _objective(
        reached=lambda state, goal: torch.zeros(3, dtype=torch.bool),
        missed=lambda state, goal: state[:, 0] > torch.ones(3),
        reward=lambda *_: torch.zeros(3),
    )
    expected = "expected a tensor on meta, where its inputs are, got cpu"
    with pytest.raises(BadInputError, match=rf"^objective.reached\(state, goal\): {expected}$"):
        judged(objective, "reached", there, there)
    with pytest.raises(BadInputError, match=rf"^objective.reward\(.*\): {expected}$"):
        paid(objective, there, there, there, there[:, 0] > 0)
    with pytest.raises(
        BadInputError, match=r"^objective.missed\(state, goal\) fails with RuntimeError: .*device"
    ):
        judged(objective, "missed", there, there)
