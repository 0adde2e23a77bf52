import math
from dataclasses import replace

import pytest
import torch
from toy_walks import FPS, piece

from astra_data.studies.motion import chained
from astra_data.studies.predictors import Gains
from astra_data.studies.sequences import Sequences, StepsConfig, Stretch
from astra_data.studies.walking import HALF_SEEN_M, WALKER, bounded

CONFIG = StepsConfig(rows=10, history=4)


@pytest.fixture(scope="module")
def stretch() -> Stretch:
    sequences = Sequences.of_pieces([piece(400, 0)], FPS, CONFIG)
    return sequences.stretches(*sequences.starts(4, 3), 4, 3)


def test_a_ball_is_seen_in_its_direction_and_nearer_than_one() -> None:
    ball = torch.tensor([[3.0, 4.0], [0.0, -HALF_SEEN_M], [0.0, 0.0], [1e6, 0.0]])
    seen = bounded(ball)
    torch.testing.assert_close(seen[0], torch.tensor([0.6, 0.8]) * 5 / (5 + HALF_SEEN_M))
    torch.testing.assert_close(seen[1], torch.tensor([0.0, -0.5]))
    assert seen[2].tolist() == [0.0, 0.0]
    assert 1 - 1e-5 < seen[3, 0] <= 1


def test_before_fitting_gains_are_the_raw_simulator_and_remember_nothing(stretch: Stretch) -> None:
    model = Gains()
    memory = model.begin(stretch)
    assert memory.shape == (len(stretch), 0)
    simulated, action = stretch.simulated[:, 0], stretch.action[:, 0]
    ball = stretch.past_seen[:, -1]
    assert torch.equal(model.motion(memory, ball, action, simulated), simulated)
    assert model.after(memory, simulated, ball, action) is memory


def test_fitted_gains_have_the_least_error_at_the_end(stretch: Stretch) -> None:
    """The turn's gain is that of least squares; given it, no other gains of the place are better."""
    model = Gains()
    model.fit(stretch)
    end = chained(stretch.motion)[:, -1]
    turn = stretch.simulated[..., 2].sum(1)
    expected = torch.linalg.lstsq(turn[:, None], end[:, 2:]).solution.item()
    assert model.gains[2].item() == pytest.approx(expected, rel=1e-4)

    def missed(gains: torch.Tensor) -> float:
        return float((chained(stretch.simulated * gains)[:, -1, :2] - end[:, :2]).square().sum())

    best = missed(model.gains)
    for axis in (0, 1):
        for change in (-0.02, 0.02):
            other = model.gains.clone()
            other[axis] += change
            assert missed(other) > best


def test_a_walk_without_turns_leaves_the_gain_of_turning_as_it_is(stretch: Stretch) -> None:
    model = Gains()
    straight = stretch.simulated * torch.tensor([1.0, 1.0, 0.0])
    model.fit(replace(stretch, simulated=straight))
    assert model.gains[2] == 1.0 and bool(model.gains.isfinite().all())


def test_gains_that_the_walk_was_made_with_are_found() -> None:
    simulated = torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(0)) * 0.1
    gains = torch.tensor([0.9, 0.6, 0.4])
    blank = torch.zeros(50, 3, 4)
    made = Stretch(
        past_motion=simulated,
        past_action=blank,
        past_seen=blank[..., :2],
        past_simulated=simulated,
        action=blank,
        simulated=simulated,
        motion=simulated * gains,
        counts=torch.ones(50, 3, dtype=torch.bool),
        heading=torch.full((50,), math.pi),
        body=WALKER,
    )
    model = Gains()
    model.fit(made)
    torch.testing.assert_close(model.gains, gains)
