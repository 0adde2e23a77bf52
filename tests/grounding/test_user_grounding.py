import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from shifted_method import Lossy, Shifted, ShiftedSimulator

from astra_data.core.errors import BadInputError
from astra_data.grounding.files import KINDS, check_step, fitted
from astra_data.robots.registry import task_named

SHIFTED = Shifted(torch.tensor([0.01]))


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, Shifted.kind, Shifted)


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (SHIFTED, "fit returned a Shifted: expected a pair, the grounding and a dict of figures"),
        (None, "fit returned a NoneType: expected a pair"),
        ((SHIFTED, {}, 1), "fit returned a tuple: expected a pair"),
        ((SHIFTED, 0.5), "fit returned a float of figures: expected a dict"),
        (
            (Lossy(torch.zeros(1)), {}),
            "fit returned a Lossy, which cannot be read again: expected grounding=Lossy of the Method",
        ),
        ((torch.zeros(1), {}), "fit returned a Tensor, which cannot be read again"),
        (
            (SHIFTED, {"a": 1, "loss": torch.zeros(()), "n": np.int64(3)}),
            "the figures of fit: 'loss' is a Tensor, 'n' is a int64: expected numbers, texts, lists or dicts",
        ),
        (
            (SHIFTED, {"r2": math.nan, "losses": [1.0, -math.inf]}),
            "the figures of fit: 'r2' is not finite, 'losses' is not finite: expected .* or None for what",
        ),
        (
            (SHIFTED, {("train", "loss"): 0.5, 2: 0.1}),
            r"the figures of fit are named \('train', 'loss'\), 2: expected texts",
        ),
    ],
)
def test_what_is_no_such_pair_is_refused(returned: object, told: str, known: None) -> None:
    with pytest.raises(BadInputError, match=f"^{told}"):
        fitted(returned)


def windows_of(count: int) -> Any:
    """Return episodes that begin on the rail of small_cart.py."""

    class Windows:
        state, goal, action = (torch.full((count, 5, 1), value) for value in (0.0, 1.0, 0.5))

    class Episodes:
        windows = Windows

    return Episodes


RAIL = f"{Path(__file__).parents[1] / 'small_cart.py'}:TASK"


@pytest.mark.parametrize(
    ("landed", "told"),
    [
        (lambda self, action: self.simulator.step(action)[:, :0], r"expected states of shape \(2, 1\), got \(2, 0\)"),
        (lambda self, action: self.simulator.step(action)[:1], r"expected states of shape \(2, 1\), got \(1, 1\)"),
        (lambda self, action: None, r"expected states of shape \(2, 1\), got a NoneType"),
    ],
)
def test_a_step_that_is_no_states_is_refused(
    landed: Callable[..., object], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ShiftedSimulator, "step", landed)
    with pytest.raises(BadInputError, match=f"^ShiftedSimulator.step: {told}$"):
        check_step(task_named(RAIL), SHIFTED, windows_of(4))


@pytest.mark.parametrize("shift_m", [0.01, 1e-5])
def test_a_step_that_leaves_its_simulator_uncorrected_is_refused(
    shift_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ShiftedSimulator, "step", lambda self, action: self.simulator.step(action) + self.shift)
    told = (
        rf"^ShiftedSimulator.step: returned states up to {shift_m:.3g}\d* from its simulator's, which would "
        r"go on uncorrected: expected `return self._settle\(before, corrected\)`"
    )
    with pytest.raises(BadInputError, match=told):
        check_step(task_named(RAIL), Shifted(torch.tensor([shift_m])), windows_of(4))
