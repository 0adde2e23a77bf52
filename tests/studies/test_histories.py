from dataclasses import replace

import pytest
import torch
from toy_walks import FPS, piece

from astra_data.grounding.model import LossWeights
from astra_data.studies.histories import HistoryModel
from astra_data.studies.rollouts import rollout
from astra_data.studies.sequences import Sequences, StepsConfig, Stretch
from astra_data.studies.walking import WALKER, bounded

HISTORY = 5


@pytest.fixture(scope="module")
def stretch() -> Stretch:
    sequences = Sequences.of_pieces([piece(600, 0)], FPS, StepsConfig(rows=10, history=HISTORY))
    return sequences.stretches(*sequences.starts(HISTORY, 3), HISTORY, 3)


def model_of(stretch: Stretch, weights: LossWeights | None = None) -> HistoryModel:
    torch.manual_seed(0)
    model = HistoryModel(8, (16,), weights or LossWeights(0.1, 1.0, 1.0), WALKER)
    model.set_scales(stretch)
    return model


def test_scales_come_from_histories_and_from_steps_of_walking_ahead(stretch: Stretch) -> None:
    walking = torch.ones_like(stretch.counts)
    walking[::3] = False
    wild = torch.where(walking[..., None], stretch.motion, torch.full_like(stretch.motion, 50.0))
    model = model_of(replace(stretch, motion=wild, counts=walking)).grounding
    torch.testing.assert_close(model.state_std, stretch.past_motion.flatten(0, 1).std(0).clamp_min(1e-3))
    correction = (stretch.motion - stretch.simulated)[walking]
    torch.testing.assert_close(model.correction_std, correction.std(0).clamp_min(1e-3))
    forward = stretch.past_motion[..., 0].mean()
    torch.testing.assert_close(model.state_mean, torch.stack([forward, *torch.zeros(2)]))
    assert model.goal_mean[1] == 0 != model.goal_mean[0]


def test_the_hidden_state_after_a_history_is_that_of_its_steps_one_by_one(stretch: Stretch) -> None:
    model = model_of(stretch)
    shorter = replace(
        stretch,
        **{
            name: getattr(stretch, name)[:, :-1]
            for name in ("past_motion", "past_seen", "past_action", "past_simulated")
        },
    )
    last = (stretch.past_motion[:, -1], stretch.past_seen[:, -1], stretch.past_action[:, -1])
    torch.testing.assert_close(model.after(model.begin(shorter), *last), model.begin(stretch))


def test_motions_are_those_of_the_grounding_models_correction(stretch: Stretch) -> None:
    model = model_of(stretch)
    memory = model.begin(stretch)
    action, simulated = stretch.action[:, 0], stretch.simulated[:, 0]
    found = model.motion(memory, stretch.past_seen[:, -1], action, simulated)
    latent = model.grounding.encoder.latent(memory)
    torch.testing.assert_close(found, model.grounding.correct(latent, action, simulated))
    # A ball elsewhere changes nothing now, as it is part of the memory.
    torch.testing.assert_close(found, model.motion(memory, torch.zeros(len(memory), 2), action, simulated))


def test_nas_has_no_loss_of_its_own_and_astra_one_of_latent_and_reward(stretch: Stretch) -> None:
    nas = model_of(stretch, LossWeights(0.0, 0.0, 1.0))
    assert float(nas.loss(stretch)) == 0.0
    losses = {
        weights: float(model_of(stretch, LossWeights(*weights)).loss(stretch).detach())
        for weights in ((1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (1.0, 1.0, 1.0), (0.0, 1.0, 100.0))
    }
    assert losses[0.0, 1.0, 1.0] > 0
    # The weight of the state's loss does not count.
    assert losses[0.0, 1.0, 100.0] == losses[0.0, 1.0, 1.0]
    assert losses[1.0, 1.0, 1.0] != pytest.approx(losses[1.0, 0.0, 1.0], rel=1e-4)


def test_the_reward_is_how_much_nearer_the_ball_comes(stretch: Stretch) -> None:
    model = model_of(stretch).grounding
    distance = bounded(stretch.past_seen).norm(dim=-1)
    nearer = (distance[:, :-1] - distance[:, 1:]).flatten()
    torch.testing.assert_close(model.reward_mean, nearer.mean()[None])
    torch.testing.assert_close(model.reward_std, nearer.std(correction=0).clamp_min(1e-3)[None])


def test_steps_that_are_not_walking_are_not_learned_from(stretch: Stretch) -> None:
    """There the simulator's motion stands in the history: whatever it is, the loss has no such term."""
    model = model_of(stretch, LossWeights(0.0, 1.0, 1.0))
    still = replace(stretch, past_motion=stretch.past_simulated.clone())
    still.past_motion[:, 1] += 0.1  # of all steps after the first one alone is walking
    once = float(model.loss(still).detach())

    def changes(column: str, steps: slice, *, turned: bool = False) -> bool:
        """Return whether the loss depends on these steps of the history."""
        values = getattr(still, column).clone()
        values[:, steps] = -values[:, steps] if turned else values[:, steps] + 0.7
        return float(model.loss(replace(still, **{column: values})).detach()) != pytest.approx(once, rel=1e-5)

    # How much nearer the ball comes in step 1 is predicted from step 0 and the action of step 1.
    assert changes("past_seen", slice(0, 1)) and changes("past_seen", slice(1, 2))
    assert changes("past_action", slice(0, 1)) and changes("past_action", slice(1, 2))
    assert not changes("past_seen", slice(2, None))
    assert not changes("past_action", slice(2, None))
    # A ball on the other side is as far away: of that, only step 0 is an input.
    assert changes("past_seen", slice(0, 1), turned=True)
    assert not changes("past_seen", slice(1, 2), turned=True)


def test_a_history_of_one_step_has_nothing_to_learn_from() -> None:
    sequences = Sequences.of_pieces([piece(200, 0)], FPS, StepsConfig(rows=10, history=1))
    short = sequences.stretches(*sequences.starts(1, 3), 1, 3)
    model = model_of(short)
    assert model.loss(short) == 0.0
    assert rollout(model, short).isfinite().all()


def test_where_no_past_step_counts_there_is_nothing_to_learn_from(stretch: Stretch) -> None:
    model = model_of(stretch)
    assert model.loss(replace(stretch, past_motion=stretch.past_simulated)) == 0.0
