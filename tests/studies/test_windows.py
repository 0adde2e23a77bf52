from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from toy_walks import FPS, piece

from astra_data.studies.sequences import Sequences, StepsConfig, Stretch
from astra_data.studies.walking import WALKER, bounded
from astra_data.studies.windows import WindowModel

HISTORY = 4


@pytest.fixture(scope="module")
def stretch() -> Stretch:
    sequences = Sequences.of_pieces([piece(600, 0)], FPS, StepsConfig(rows=10, history=HISTORY))
    return sequences.stretches(*sequences.starts(HISTORY, 2), HISTORY, 2)


def step(stretch: Stretch) -> tuple[Tensor, Tensor, Tensor]:
    return stretch.past_seen[:, -1], stretch.action[:, 0], stretch.simulated[:, 0]


def linear(stretch: Stretch) -> WindowModel:
    model = WindowModel(HISTORY, WALKER).requires_grad_(False)
    model.set_scales(stretch)
    return model


def test_before_fitting_the_correction_is_zero(stretch: Stretch) -> None:
    for hidden in ((), (8,)):
        model = WindowModel(HISTORY, WALKER, hidden)
        model.set_scales(stretch)
        assert torch.equal(model.motion(model.begin(stretch), *step(stretch)), stretch.simulated[:, 0])


def test_scales_are_those_of_walked_steps(stretch: Stretch) -> None:
    wild = torch.full_like(stretch.motion, 100.0)
    walking = torch.ones_like(stretch.counts)
    walking[::2] = False
    part = replace(stretch, motion=torch.where(walking[..., None], stretch.motion, wild), counts=walking)
    model = linear(part)
    walked, simulated = stretch.motion[1::2].flatten(0, 1), stretch.simulated[1::2].flatten(0, 1)
    torch.testing.assert_close(model.motion_std, walked.std(0))
    torch.testing.assert_close(model.motion_mean, walked.mean(0) * torch.tensor([1.0, 0.0, 0.0]))
    torch.testing.assert_close(model.correction_std, (walked - simulated).std(0))


def test_the_window_moves_on_with_each_step(stretch: Stretch) -> None:
    model = linear(stretch)
    memory = model.begin(stretch)
    motion, action = stretch.motion[:, 0], stretch.action[:, 0]
    moved = model.after(memory, motion, stretch.past_seen[:, -1], action).view(-1, HISTORY, 7)
    torch.testing.assert_close(moved[:, -1], torch.cat([motion, action], dim=-1))
    torch.testing.assert_close(moved[:, :-1, :3], stretch.past_motion[:, 1:])
    torch.testing.assert_close(moved[:, :-1, 3:], stretch.past_action[:, 1:])


def test_inputs_are_normalized_motions_actions_and_the_bounded_ball(stretch: Stretch) -> None:
    model = linear(stretch)
    ball, action, simulated = step(stretch)
    inputs = model.inputs(model.begin(stretch), ball, action, simulated)
    past, actions, now, seen, predicted = inputs.split((3 * HISTORY, 4 * HISTORY, 4, 2, 3), dim=-1)
    normal = (stretch.past_motion - model.motion_mean) / model.motion_std
    torch.testing.assert_close(past, normal.flatten(1))
    torch.testing.assert_close(actions, stretch.past_action.flatten(1))
    torch.testing.assert_close(now, action)
    torch.testing.assert_close(seen, bounded(ball))
    torch.testing.assert_close(predicted, (simulated - model.motion_mean) / model.motion_std)


@pytest.mark.parametrize("strength", [1e-3, 1.0])
def test_ridge_regression_is_least_squares_with_a_row_for_each_penalty(
    stretch: Stretch, strength: float
) -> None:
    model = linear(stretch)
    model.solve(stretch, strength)
    inputs = model.inputs(model.begin(stretch), *step(stretch)).double().numpy()
    correction = (stretch.motion - stretch.simulated)[:, 0].double().numpy()
    # The penalty is relative to the samples, and spares the intercept, so all is centered.
    centered = inputs - inputs.mean(axis=0)
    penalty = np.sqrt(strength * len(inputs)) * np.eye(inputs.shape[1])
    target = np.concatenate([correction - correction.mean(axis=0), np.zeros((len(penalty), 3))])
    weights = np.linalg.lstsq(np.concatenate([centered, penalty]), target)[0]
    expected = stretch.simulated[:, 0].numpy() + centered @ weights + correction.mean(axis=0)
    found = model.motion(model.begin(stretch), *step(stretch))
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-5)
