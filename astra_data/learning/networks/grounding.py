"""ASTRA's grounding model: history encoder, latent dynamics, reward, correction; and their joint loss.

Paper, Section IV-A. With the weights (0, 0, 1) it is NAS in the paper's sense: only the correction is fitted.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from astra_data.core.numbers import normalized
from astra_data.learning.networks.history import HistoryEncoder, PositionFeatures, mlp
from astra_data.learning.networks.paired_windows import RISK_STEPS, PairedWindows
from astra_data.learning.networks.scales import add_scales, take_scales

TargetKind = Literal["ema", "detach", "online"]

_BALL_M = 0.1
"""Unit of the ball's position relative to the robot: less than this decides whether they touch."""
_LEAST_DISAGREEMENT = 1e-9
"""On the data, in standard deviations of the correction; 0 where there was nothing to correct."""


@dataclass(frozen=True)
class LossWeights:
    """λ1, λ2, λ3 of the paper's total loss, and of what R_pred and the topple head learn of failures."""

    latent: float = 1.0
    reward: float = 1.0
    state: float = 1.0
    failures: float = 1.0


@dataclass(frozen=True)
class GroundingShape:
    """Sizes of the networks; the paper prints none.

    Attributes:
        state_size: X. action_size: A. goal_size: G, appended to the state where the encoder sees it.
        position_octaves: of `PositionFeatures`; 0 for none, as in states without a position.
        ball_index: index in the state where the position of a ball begins; None where there is no ball.
        correction_heads: K, heads of f_abs, whose mean corrects.
        corrects_reward: R_pred is fitted to the residual reward: the target's less the task's own.
        reward_dropout: dropout rate of the latent that R_pred is given in training.
    """

    state_size: int
    action_size: int
    goal_size: int
    latent_size: int = 64
    embedding_size: int = 64
    head_sizes: tuple[int, ...] = (128, 128)
    position_octaves: int = 4
    ball_index: int | None = None
    correction_heads: int = 1
    corrects_reward: bool = False
    reward_dropout: float = 0.0
    log_variance_bounds: tuple[float, float] = (-6.0, 2.0)


class GroundingModel(nn.Module):
    """ψ^s, P_lat, R_pred and f_abs on one GRU backbone, plus a topple head without gradient to the latent.

    Scales are buffers, so checkpoints hold them; `set_scales` and `set_reward_scales` take them from the
    training episodes.
    """

    def __init__(self, shape: GroundingShape, target: TargetKind = "ema") -> None:
        super().__init__()
        self.shape = shape
        self.target = target
        states, actions, latent = shape.state_size, shape.action_size, shape.latent_size
        self.position_features = PositionFeatures(shape.position_octaves)
        features = states + self.position_features.size + (0 if shape.ball_index is None else 3)
        self.encoder = HistoryEncoder(
            features + shape.goal_size + actions, embedding_size=shape.embedding_size, latent_size=latent
        )
        heads = shape.head_sizes
        self.latent_dynamics = mlp((latent + actions, *heads, 2 * latent))
        self.reward_head = mlp((latent + actions, *heads, 2))
        sizes = (latent + actions + features, *heads, states)
        self.corrections = nn.ModuleList(mlp(sizes) for _ in range(shape.correction_heads))
        self.topple_head = mlp((latent + actions + features, *heads, 1))
        # An untrained correction is the identity: the raw simulator.
        for head in self.corrections:
            for parameter in list(head.parameters())[-2:]:
                nn.init.zeros_(parameter)
        self.target_encoder = copy.deepcopy(self.encoder).requires_grad_(False)
        add_scales(self, {"state": states, "goal": shape.goal_size, "correction": states})
        self.register_buffer("reward_mean", torch.zeros(()))
        self.register_buffer("reward_std", torch.ones(()))
        self.register_buffer("failure_cost", torch.zeros(()))
        self.register_buffer("failure_weight", torch.zeros(()))
        self.register_buffer("residual_factor", torch.zeros(states, states))
        self.register_buffer("usual_disagreement", torch.ones(()))
        self.state_mean: Tensor
        self.state_std: Tensor
        self.goal_mean: Tensor
        self.goal_std: Tensor
        self.correction_std: Tensor
        self.reward_mean: Tensor
        self.reward_std: Tensor
        self.failure_cost: Tensor
        self.failure_weight: Tensor
        self.residual_factor: Tensor
        self.usual_disagreement: Tensor

    def set_scales(self, columns: Mapping[str, Tensor]) -> None:
        """Take means and deviations from training steps: state, goal, correction (N, ...)."""
        take_scales(self, columns)

    @torch.no_grad()
    def set_reward_scales(
        self, reward: Tensor, goes_on: Tensor, failed: Tensor, failure_weight: float = 1.0
    ) -> None:
        """Take the scales of `reward` (N, 2), in its two parts (see `PairedWindows`), from training steps.

        Steps that `failed` (N,) end in failure. Mean and deviation are those of steps where `goes_on` (N,) is
        1. The reward head starts at the rate of failures, whose loss counts by rarity times `failure_weight`.
        """
        failed = failed.bool()
        if goes_on.any():
            paid = reward[goes_on.bool(), 0]
            self.reward_mean.copy_(paid.mean())
            self.reward_std.copy_(paid.std(correction=0).clamp_min(1e-3))
        if failed.any():
            rate = failed.float().mean().clamp(max=0.5)
            self.failure_cost.copy_((reward[failed, 1].mean() - self.reward_mean).clamp_max(0.0))
            self.failure_weight.copy_(failure_weight / functional.binary_cross_entropy(rate, rate))
            list(self.reward_head.parameters())[-1][1] = rate.logit()

    def state_features(self, state: Tensor) -> Tensor:
        """Normalize abstract states (..., X) and append features of the robot's and the ball's position."""
        position, index = state[..., :2], self.shape.ball_index
        features = [normalized(state, self.state_mean, self.state_std), self.position_features(position)]
        if index is not None:
            apart = state[..., index : index + 2] - position
            near = torch.cat([apart, apart.norm(dim=-1, keepdim=True)], dim=-1)
            features.append(normalized(near, 0.0, _BALL_M))
        return torch.cat(features, dim=-1)

    def normal_goal(self, goal: Tensor) -> Tensor:
        """Normalize goals (..., G)."""
        return normalized(goal, self.goal_mean, self.goal_std)

    def encoder_input(self, state: Tensor, goal: Tensor, previous_action: Tensor) -> Tensor:
        """Assemble x_i = [φ(s_i), goal, a_{i-1}] (..., I) for the encoder."""
        return torch.cat([self.state_features(state), self.normal_goal(goal), previous_action], dim=-1)

    def encode(self, windows: PairedWindows) -> tuple[Tensor, Tensor]:
        """Return the latents (B, T, Z) and hidden states (B, T, H) of histories that begin with `windows`."""
        latent, hidden = self.encoder(
            self.encoder_input(windows.state, windows.goal, windows.previous_action)
        )
        return latent, hidden

    def predict_latent(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """P_lat: return mean and log-variance (..., Z) of the next latent."""
        mean, raw = self.latent_dynamics(torch.cat([latent, action], dim=-1)).chunk(2, dim=-1)
        low, high = self.shape.log_variance_bounds
        return mean, low + (high - low) * torch.sigmoid(raw)

    def target_reward(
        self, latent: Tensor, action: Tensor, own: Tensor, hazard: Tensor | None = None
    ) -> Tensor:
        """Return the target's reward (...) of a step, given the task's `own` (...) on abstract states.

        A `hazard` (...), the probability that the step fails by a failure model, replaces R_pred's own.
        """
        if hazard is None:
            predicted = self.predict_reward(latent, action)
        else:
            going_on, _ = self.predict_reward_parts(latent, action).unbind(-1)
            predicted = going_on + hazard * self.failure_cost
        return predicted + own if self.shape.corrects_reward else predicted

    def predict_reward(self, latent: Tensor, action: Tensor) -> Tensor:
        """R_pred: return the target's reward (...), or the residual reward if it was fitted to that."""
        return self.predict_reward_parts(latent, action).sum(-1)

    def predict_reward_parts(self, latent: Tensor, action: Tensor) -> Tensor:
        """Return the two parts of the predicted reward (..., 2): of going on, and of failing.

        The latter is the probability of failing times its cost. Failures are rare and large: regressed as a
        number, their reward would be as often positive as negative away from the data, and policies would
        exploit that.
        """
        going_on, log_odds = self._reward_outputs(latent, action)
        parts = [going_on * self.reward_std + self.reward_mean, log_odds.sigmoid() * self.failure_cost]
        return torch.stack(parts, dim=-1)

    def _reward_outputs(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the normalized reward of a step that goes on, and the log-odds that it fails, (...) each."""
        going_on, log_odds = self.reward_head(torch.cat([latent, action], dim=-1)).unbind(-1)
        return going_on, log_odds

    def correct(self, latent: Tensor, action: Tensor, simulated_next: Tensor) -> Tensor:
        """f_abs: return the corrected next abstract state (..., X)."""
        return self.ensemble_predictions(latent, action, simulated_next).mean(0)

    def ensemble_predictions(self, latent: Tensor, action: Tensor, simulated_next: Tensor) -> Tensor:
        """Return the next abstract state as each of the K heads corrects it, (K, ..., X)."""
        inputs = self.correction_inputs(latent, action, simulated_next)
        return torch.stack([simulated_next + head(inputs) * self.correction_std for head in self.corrections])

    def correction_inputs(self, latent: Tensor, action: Tensor, simulated_next: Tensor) -> Tensor:
        """Return what the correction sees of a step, (..., I)."""
        return torch.cat([latent, action, self.state_features(simulated_next)], dim=-1)

    def disagreement(self, predictions: Tensor) -> Tensor:
        """Return the spread (...) of ensemble predictions (K, ..., X), relative to that on the data."""
        spread = (predictions / self.correction_std).std(0).square().mean(-1).sqrt()
        return spread / self.usual_disagreement.clamp_min(_LEAST_DISAGREEMENT)

    def topple_logit(self, latent: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
        """Return the log-odds (...) of a topple within `RISK_STEPS`, on the way to `next_state`."""
        logit: Tensor = self.topple_head(self.correction_inputs(latent, action, next_state))
        return logit.squeeze(-1)

    def topple_risk(self, latent: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
        """Return the probability (...) that the target topples in this step."""
        return self.topple_logit(latent, action, next_state).sigmoid() / RISK_STEPS

    def update_target(self, rate: float) -> None:
        """Move the EMA target encoder by `rate` toward the encoder."""
        with torch.no_grad():
            for slow, fast in zip(self.target_encoder.parameters(), self.encoder.parameters(), strict=True):
                slow.lerp_(fast, rate)

    def losses(self, windows: PairedWindows, weights: LossWeights) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the joint loss (paper, Section IV-A) and its parts, each a mean over real steps and dims."""
        inputs = self.encoder_input(windows.state, windows.goal, windows.previous_action)
        latent, _ = self.encoder(inputs)
        action, mask = windows.action, windows.mask
        parts: dict[str, Tensor] = {}
        total = torch.zeros((), device=mask.device)
        if weights.latent > 0:
            following = self._following_latent(inputs, latent)
            mean, log_variance = self.predict_latent(latent[:, :-1], action[:, :-1])
            nll = 0.5 * ((following - mean).square() / log_variance.exp() + log_variance).mean(-1)
            both = mask[:, :-1] * mask[:, 1:]
            parts["latent"] = (nll * both).sum() / both.sum().clamp_min(1.0)
            total = total + weights.latent * parts["latent"]
        if weights.reward > 0:
            parts["reward"] = self._reward_loss(latent, windows)
            total = total + weights.reward * parts["reward"]
        parts["state"] = self._correction_loss(latent, windows)
        total = total + weights.state * parts["state"]
        if weights.failures > 0:
            logit = self.topple_logit(latent.detach(), action, windows.next_state)
            surprise = functional.binary_cross_entropy_with_logits(
                logit, windows.fails_soon, reduction="none"
            )
            parts["topple"] = _masked_mean(surprise, mask)
            total = total + weights.failures * parts["topple"]
        return total, parts

    def _reward_loss(self, latent: Tensor, windows: PairedWindows) -> Tensor:
        """Return the mean of the losses of both parts of the reward.

        Predicting the averages gives a loss of about one for the steps that go on, and of its weight for the
        failures; the latter is zero where the data has none. What a success pays is not R_pred's to learn.
        """
        if self.shape.reward_dropout:
            latent = functional.dropout(latent, self.shape.reward_dropout, self.training)
        going_on, log_odds = self._reward_outputs(latent, windows.action)
        error = windows.goes_on * (going_on - (windows.reward[..., 0] - self.reward_mean) / self.reward_std)
        surprise = functional.binary_cross_entropy_with_logits(log_odds, windows.failed, reduction="none")
        return 0.5 * _masked_mean(error.square() + self.failure_weight * surprise, windows.mask)

    def _correction_loss(self, latent: Tensor, windows: PairedWindows) -> Tensor:
        predictions = self.ensemble_predictions(latent, windows.action, windows.simulated_next)
        error = ((predictions - windows.next_state) / self.correction_std).square().mean(-1)
        mask = windows.mask.expand_as(error)
        if len(predictions) > 1:
            # Each head learns from its own half of every batch, so that heads differ away from the data.
            mask = mask * (torch.rand(*error.shape[:2], 1, device=error.device) < 0.5)
        return _masked_mean(error, mask)

    def _following_latent(self, inputs: Tensor, latent: Tensor) -> Tensor:
        if self.target == "online":
            return latent[:, 1:]
        if self.target == "detach":
            return latent[:, 1:].detach()
        with torch.no_grad():
            slow, _ = self.target_encoder(inputs)
        return torch.as_tensor(slow[:, 1:])


def _masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of the values where the mask is 1; 0 where it is nowhere, as in a small batch."""
    return (values * mask).sum() / mask.sum().clamp_min(1.0)
