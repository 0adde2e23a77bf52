"""ASTRA and NAS on recordings: the grounding model, with the motions of steps as states."""

from dataclasses import replace

import torch
from torch import Tensor

from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights
from astra_data.grounding.paired_episodes import PairedWindows
from astra_data.studies.body import Body
from astra_data.studies.predictors import LEAST_DEVIATION, Predictor
from astra_data.studies.sequences import Stretch
from astra_data.studies.windows import WindowModel


class HistoryModel(Predictor):
    """A `GroundingModel` whose state is the last step's motion and whose goal is what is seen.

    Of a walk these are in the body's frame and depend neither on position nor on heading in the field.
    The logs hold no reward: instead, L_rew predicts how much nearer the ball comes, or joints to targets.
    With a `base`, f_abs corrects that model's motion instead of the simulator's.
    """

    def __init__(
        self,
        latent_size: int,
        head_sizes: tuple[int, ...],
        weights: LossWeights,
        body: Body,
        base: WindowModel | None = None,
    ) -> None:
        super().__init__()
        self.body, self.latent_size = body, latent_size
        shape = GroundingShape(
            state_size=body.motion_size,
            action_size=body.given_size,
            goal_size=body.seen_size,
            latent_size=latent_size,
            head_sizes=head_sizes,
            position_octaves=0,
            corrects_reward=False,
        )
        self.grounding = GroundingModel(shape)
        self.weights = weights
        self.base = base
        self.register_buffer("given_std", torch.ones(body.given_size))
        self.given_std: Tensor

    def set_scales(self, stretch: Stretch) -> None:
        """Set the input scales from the histories, and the correction's from the future steps that count."""
        counts = stretch.counts
        correction = (stretch.motion - stretch.simulated)[counts]
        if self.base is not None:
            correction = self.base.residuals(stretch)
        nearer = self._nearer(stretch)
        model = self.grounding
        model.set_scales(
            {
                "state": stretch.past_motion.flatten(0, 1),
                "goal": self.body.features(stretch.past_seen).flatten(0, 1),
                "correction": correction,
            }
        )
        rewards = nearer.reshape(-1, 1)
        model.set_reward_scales(rewards, torch.ones_like(rewards[:, 0]), torch.zeros_like(rewards[:, 0]))
        model.state_mean *= model.state_mean.new_tensor(self.body.usual_motion)
        model.goal_mean *= model.goal_mean.new_tensor(self.body.usual_seen)
        if self.body.is_scaled and self.body.given_size:
            self.given_std.copy_(stretch.past_action.flatten(0, 1).std(0).clamp_min(LEAST_DEVIATION))

    def begin(self, stretch: Stretch) -> Tensor:
        """Return the hidden state (B, Z) after the history, and the memory of the base."""
        _, hidden = self.grounding.encoder(
            self._inputs(stretch.past_motion, stretch.past_seen, stretch.past_action)
        )
        own = torch.as_tensor(hidden[:, -1])
        return own if self.base is None else torch.cat([own, self.base.begin(stretch)], dim=-1)

    def motion(self, memory: Tensor, seen: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the corrected motion (f_abs)."""
        own, its = memory.tensor_split([self.latent_size], dim=-1)
        if self.base is not None:
            simulated = self.base.motion(its, seen, action, simulated)
        return self.grounding.correct(self.grounding.encoder.latent(own), action / self.given_std, simulated)

    def after(self, memory: Tensor, motion: Tensor, seen: Tensor, action: Tensor) -> Tensor:
        """Return the memory, as of `begin`, after a step."""
        own, its = memory.tensor_split([self.latent_size], dim=-1)
        own = self.grounding.encoder.step(self._inputs(motion, seen, action), own)
        return own if self.base is None else torch.cat([own, self.base.after(its, motion, seen, action)], -1)

    def loss(self, stretch: Stretch) -> Tensor:
        """Return λ1 L_trans + λ2 L_rew (paper, Section IV-A) over the history, each step given the true past.

        L_state is part of open-loop prediction, see `rollouts`. The loss is 0 in a history of one step.
        """
        if self.weights.latent == self.weights.reward == 0.0 or stretch.past_motion.shape[1] == 1:
            return stretch.motion.new_zeros(())
        motion, simulated = stretch.past_motion, stretch.past_simulated
        nearer = self._nearer(stretch)
        given = stretch.past_action / self.given_std
        windows = PairedWindows(
            state=motion[:, :-1],
            action=given[:, 1:],
            previous_action=given[:, :-1],
            goal=self.body.features(stretch.past_seen[:, :-1]),
            simulated_next=simulated[:, 1:],
            next_state=motion[:, 1:],
            reward=nearer,
            goes_on=torch.ones_like(nearer),
            failed=torch.zeros_like(nearer),
            fails_soon=torch.zeros_like(nearer),
            # Where steps do not count, the simulator's motion stands in: nothing to learn.
            mask=(motion != simulated)[:, 1:].any(-1).float(),
        )
        total, _ = self.grounding.losses(windows, replace(self.weights, state=0.0))
        return total

    def _nearer(self, stretch: Stretch) -> Tensor:
        return self.body.nearer(stretch.past_seen, stretch.past_action, stretch.past_motion)

    def _inputs(self, motion: Tensor, seen: Tensor, action: Tensor) -> Tensor:
        return self.grounding.encoder_input(motion, self.body.features(seen), action / self.given_std)
