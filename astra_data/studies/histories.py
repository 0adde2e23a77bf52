"""ASTRA and NAS on a walk: the grounding model, with motions in the body's frame as states."""

from dataclasses import replace

import torch
from torch import Tensor

from astra_data.learning.networks.grounding import GroundingModel, GroundingShape, LossWeights
from astra_data.learning.networks.paired_windows import PairedWindows
from astra_data.studies.predictors import Predictor, bounded
from astra_data.studies.walks import Stretch


class HistoryModel(Predictor):
    """A `GroundingModel` whose state is the last step's motion and whose goal is the ball.

    Motions in the body's frame do not depend on position and heading in the field, so neither does the model.
    The logs hold no reward: instead, L_rew predicts the decrease of the ball's bounded distance.
    """

    def __init__(self, latent_size: int, head_sizes: tuple[int, ...], weights: LossWeights) -> None:
        super().__init__()
        shape = GroundingShape(
            state_size=3,
            action_size=4,
            goal_size=2,
            latent_size=latent_size,
            head_sizes=head_sizes,
            position_octaves=0,
        )
        self.grounding = GroundingModel(shape)
        self.weights = weights

    def set_scales(self, stretch: Stretch) -> None:
        """Set the input scales from the histories, and the correction's from the future steps of walking."""
        walked = stretch.is_walking
        nearer = _nearer(stretch.past_ball)
        model = self.grounding
        model.set_scales(
            {
                "state": stretch.past_motion.flatten(0, 1),
                "goal": bounded(stretch.past_ball).flatten(0, 1),
                "correction": (stretch.motion - stretch.simulated)[walked],
            }
        )
        rewards = torch.stack([nearer, torch.zeros_like(nearer)], dim=-1).flatten(0, 1)
        model.set_reward_scales(rewards, torch.ones_like(rewards[:, 0]))
        # Sideways and in turn a mean other than zero is an accident of the recordings.
        model.state_mean[1:] = 0.0
        model.goal_mean[1:] = 0.0

    def begin(self, stretch: Stretch) -> Tensor:
        """Return the hidden state (B, Z) after the history."""
        inputs = (stretch.past_motion, bounded(stretch.past_ball), stretch.past_action)
        _, hidden = self.grounding.encoder(self.grounding.encoder_input(*inputs))
        return torch.as_tensor(hidden[:, -1])

    def motion(self, memory: Tensor, ball: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the corrected motion (f_abs)."""
        return self.grounding.correct(self.grounding.encoder.latent(memory), action, simulated)

    def after(self, memory: Tensor, motion: Tensor, ball: Tensor, action: Tensor) -> Tensor:
        """Return the hidden state (B, Z) after a step."""
        inputs = self.grounding.encoder_input(motion, bounded(ball), action)
        return self.grounding.encoder.step(inputs, memory)

    def loss(self, stretch: Stretch) -> Tensor:
        """Return λ1 L_trans + λ2 L_rew (paper, Section IV-A) over the history, each step given the true past.

        L_state is part of open-loop prediction, see `rollouts`.
        """
        if self.weights.latent == self.weights.reward == 0.0:
            return stretch.motion.new_zeros(())
        motion, simulated = stretch.past_motion, stretch.past_simulated
        nearer = _nearer(stretch.past_ball)
        windows = PairedWindows(
            state=motion[:, :-1],
            action=stretch.past_action[:, 1:],
            previous_action=stretch.past_action[:, :-1],
            goal=bounded(stretch.past_ball[:, :-1]),
            simulated_next=simulated[:, 1:],
            next_state=motion[:, 1:],
            reward=torch.stack([nearer, torch.zeros_like(nearer)], dim=-1),
            goes_on=torch.ones_like(nearer),
            topples_soon=torch.zeros_like(nearer),
            # Where the robot did not walk, the simulator's motion stands in: nothing to learn.
            mask=(motion != simulated)[:, 1:].any(-1).float(),
        )
        total, _ = self.grounding.losses(windows, replace(self.weights, state=0.0))
        return total


def _nearer(ball: Tensor) -> Tensor:
    """Return the decrease (B, T - 1) of the bounded distance of the ball (B, T, 2)."""
    distance: Tensor = bounded(ball).norm(dim=-1)
    return distance[:, :-1] - distance[:, 1:]
