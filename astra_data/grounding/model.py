"""ASTRA's grounding model and its joint loss (paper, Section IV-A); with weights (0, 0) it is the paper's NAS."""

import copy
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from astra_data.core.arrays import normalized
from astra_data.core.errors import BadInputError
from astra_data.grounding.encoder import ENCODERS, HistoryEncoder, PositionFeatures, mlp
from astra_data.grounding.paired_episodes import PairedEpisodes, PairedWindows

_TOUCHED = 0.1  # of the deviation of corrections: a ball that needs more of one is touched
_BALL_M = 0.1  # unit of the ball's position relative to the robot: less than this decides whether they touch
_EMA_RATE = 0.01  # by how much the target encoder follows the encoder in each update


@dataclass(frozen=True)
class LossWeights:
    """The weights of the loss, λ1 and λ2 in the paper; λ3, that of the correction, is 1."""

    latent: float = 0.1
    reward: float = 1.0


@dataclass(frozen=True)
class GroundingShape:
    """Sizes of the networks; the paper prints none."""

    state_size: int
    action_size: int
    goal_size: int  # of what is appended to the state where the encoder sees it
    latent_size: int = 64
    embedding_size: int = 64
    head_sizes: tuple[int, ...] = (128, 128)
    position_octaves: int = 4  # of `PositionFeatures`; 0 for none, as in states without a position
    ball_index: int | None = None  # in the state, where the position of a ball begins; None where there is none
    ball_rolls: bool = False  # its velocity follows, and ends the state
    corrects_reward: bool = True  # R_pred predicts the residual reward, the target's less the task's own, as well
    log_variance_bounds: tuple[float, float] = (-6.0, 2.0)
    encoder: str = HistoryEncoder.kind  # see `ENCODERS`

    @property
    def lying_ball(self) -> slice | None:
        """Where states hold a ball's position without its velocity: it lies there until it is touched."""
        index = self.ball_index
        return None if index is None or self.ball_rolls else slice(index, index + 2)


class GroundingModel(nn.Module):
    """ψ^s, P_lat, R_pred and f_abs on one history encoder; scales are buffers, so that files hold them."""

    def __init__(self, shape: GroundingShape) -> None:
        super().__init__()
        self.shape = shape
        states, actions, latent = shape.state_size, shape.action_size, shape.latent_size
        self.position_features = PositionFeatures(shape.position_octaves)
        features = states + self.position_features.size + (0 if shape.ball_index is None else 3)
        self.encoder = ENCODERS[shape.encoder](
            features + shape.goal_size + actions, embedding_size=shape.embedding_size, latent_size=latent
        )
        heads, rewards = shape.head_sizes, 2 if shape.corrects_reward else 1
        self.latent_dynamics = mlp((latent + actions, *heads, 2 * latent))
        self.reward_head = mlp((latent + actions, *heads, rewards))
        self.correction = mlp((latent + actions + features, *heads, states))
        # Hits are too few to be learned beside the rest: see `fit_hits`.
        self.corrected_size = states - 2 if shape.ball_rolls else states
        self.hits = mlp((latent + actions + features, *heads, 1)) if shape.ball_rolls else None
        self.touched = mlp((latent + actions + features, *heads, 1)) if shape.lying_ball else None
        # An untrained correction is the identity: the raw simulator.
        for network in (self.correction, *([self.hits] if self.hits else [])):
            for parameter in list(network.parameters())[-2:]:
                nn.init.zeros_(parameter)
        self.target_encoder = copy.deepcopy(self.encoder).requires_grad_(False)
        self.state_mean, self.state_std = nn.Buffer(torch.zeros(states)), nn.Buffer(torch.ones(states))
        self.goal_mean, self.goal_std = nn.Buffer(torch.zeros(shape.goal_size)), nn.Buffer(torch.ones(shape.goal_size))
        self.correction_mean, self.correction_std = nn.Buffer(torch.zeros(states)), nn.Buffer(torch.ones(states))
        self.reward_mean, self.reward_std = nn.Buffer(torch.zeros(rewards)), nn.Buffer(torch.ones(rewards))
        self.reward_shrinkage, self.failure_cost = nn.Buffer(torch.ones(())), nn.Buffer(torch.zeros(()))

    @torch.no_grad()
    def set_reward_scales(self, reward: Tensor, known: Tensor, failed: Tensor) -> None:
        """Take scales of rewards (N, R), from `known` steps (N,), and the cost of a failure, from `failed` ones."""
        known, failed = known.bool(), failed.bool()
        if known.any():
            self.reward_mean.copy_(reward[known].mean(0))
            self.reward_std.copy_(reward[known].std(0, correction=0).clamp_min(1e-3))
        if failed.any():
            cost = reward[failed, -1].mean() - self.reward_mean[-1]
            self.failure_cost.copy_(cost.clamp_max(0.0))

    @torch.no_grad()
    def shrink_reward(self, windows: PairedWindows) -> None:
        """Shrink predicted residuals by the slope of held-out on predicted ones, so that errors pay nothing."""
        latent, _ = self.encode(windows)
        known = windows.goes_on.bool()
        predicted = self.rewards(latent, windows.action)[known][:, -1]
        recorded = recorded_rewards(windows)[known][:, -1]
        power = predicted.square().sum()
        slope = (predicted * recorded).sum() / power if power > 0 else torch.zeros_like(power)
        self.reward_shrinkage.copy_(slope.clamp(0.0, 1.0))

    def check(self, episodes: PairedEpisodes) -> None:
        """Refuse episodes whose states, goals or actions are of other sizes than those that it was fitted to."""
        shape = self.shape
        fitted = {"state": shape.state_size, "goal": shape.goal_size, "action": shape.action_size}
        found = {name: getattr(episodes.windows, name).shape[-1] for name in fitted}
        if found != fitted:
            fault = f"the grounding was fitted to values {fitted}, {episodes.reference} has {found}"
            raise BadInputError(f"{fault}: run the stage `ground` with this dataset")

    def state_features(self, state: Tensor) -> Tensor:
        """Normalize abstract states (..., X) and append features of the robot's and the ball's position."""
        position, index = state[..., :2], self.shape.ball_index
        features = [normalized(state, self.state_mean, self.state_std), self.position_features(position)]
        if index is not None:
            apart = state[..., index : index + 2] - position
            near = torch.cat([apart, apart.norm(dim=-1, keepdim=True)], dim=-1)
            features.append(normalized(near, 0.0, _BALL_M))
        return torch.cat(features, dim=-1)

    def encoder_input(self, state: Tensor, goal: Tensor, previous_action: Tensor) -> Tensor:
        """Assemble x_i = [φ(s_i), goal, a_{i-1}] (..., I) for the encoder."""
        features, normal_goal = self.state_features(state), normalized(goal, self.goal_mean, self.goal_std)
        return torch.cat([features, normal_goal, previous_action], dim=-1)

    def encode(self, windows: PairedWindows) -> tuple[Tensor, Tensor]:
        """Return the latents (B, T, Z) and memories (B, T, M) of histories that begin with `windows`."""
        return self.encoder.sequence(self.encoder_input(windows.state, windows.goal, windows.previous_action))

    def predict_latent(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """P_lat: return mean and log-variance (..., Z) of the next latent."""
        mean, raw = self.latent_dynamics(torch.cat([latent, action], dim=-1)).chunk(2, dim=-1)
        low, high = self.shape.log_variance_bounds
        return mean, low + (high - low) * torch.sigmoid(raw)

    def target_reward(self, latent: Tensor, action: Tensor, own: Tensor, hazard: Tensor | None = None) -> Tensor:
        """Return the target's reward (...), given the task's `own`, less what a `hazard` (...) of failure costs."""
        predicted = self.rewards(latent, action)[..., -1] * self.reward_shrinkage
        if self.shape.corrects_reward:
            predicted = predicted + own
        return predicted if hazard is None else predicted + hazard * self.failure_cost

    def rewards(self, latent: Tensor, action: Tensor) -> Tensor:
        """R_pred: return the predicted rewards (..., R), see `set_reward_scales`."""
        normal: Tensor = self.reward_head(torch.cat([latent, action], dim=-1))
        return normal * self.reward_std + self.reward_mean

    def correct(self, latent: Tensor, action: Tensor, simulated_next: Tensor) -> Tensor:
        """f_abs: return the corrected next abstract state (..., X)."""
        return self.corrected(self.correction_inputs(latent, action, simulated_next), simulated_next)

    def corrected(self, inputs: Tensor, simulated_next: Tensor) -> Tensor:
        """Return what `correct` does, given its `correction_inputs` (..., I)."""
        corrected: Tensor = simulated_next + self.changed(inputs, self.correction(inputs) * self.correction_std)
        if self.hits is None:
            return corrected
        return torch.cat([corrected[..., :-2], self.rolling(inputs, simulated_next)], dim=-1)

    def changed(self, inputs: Tensor, change: Tensor) -> Tensor:
        """Return the changes (..., X) of a step, those of a lying ball times the probability that it is touched."""
        if self.touched is None:
            return change
        share = torch.ones_like(change)
        share[..., self.shape.lying_ball] = self.touched(inputs).sigmoid()
        return change * share

    def rolling(self, inputs: Tensor, simulated_next: Tensor) -> Tensor:
        """Return the velocity (..., 2) of the ball: the share of the simulator's that comes true."""
        assert self.hits is not None
        share: Tensor = 2.0 * self.hits(inputs).sigmoid()
        return share * simulated_next[..., -2:]

    def correction_inputs(self, latent: Tensor, action: Tensor, simulated_next: Tensor) -> Tensor:
        """Return what the correction sees of a step, (..., I)."""
        return torch.cat([latent, action, self.state_features(simulated_next)], dim=-1)

    def update_target(self) -> None:
        """Move the target encoder toward the encoder."""
        with torch.no_grad():
            for slow, fast in zip(self.target_encoder.parameters(), self.encoder.parameters(), strict=True):
                slow.lerp_(fast, _EMA_RATE)

    def losses(self, windows: PairedWindows, weights: LossWeights) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the joint loss (paper, Section IV-A) and its parts, each a mean over real steps and dims."""
        inputs = self.encoder_input(windows.state, windows.goal, windows.previous_action)
        latent, _ = self.encoder.sequence(inputs)
        action, mask = windows.action, windows.mask
        parts: dict[str, Tensor] = {}
        total = torch.zeros((), device=mask.device)
        if weights.latent > 0:
            following = self._following_latent(inputs)
            mean, log_variance = self.predict_latent(latent[:, :-1], action[:, :-1])
            nll = 0.5 * ((following - mean).square() / log_variance.exp() + log_variance).mean(-1)
            parts["latent"] = _masked_mean(nll, mask[:, :-1] * mask[:, 1:])
            total = total + weights.latent * parts["latent"]
        if weights.reward > 0:
            # The reward itself shapes the latent (paper, L_rew); the residual is what policies are paid.
            true = (recorded_rewards(windows) - self.reward_mean) / self.reward_std
            normal = self.reward_head(torch.cat([latent, action], dim=-1))
            parts["reward"] = 0.5 * _masked_mean((normal - true).square().sum(-1), windows.goes_on * mask)
            total = total + weights.reward * parts["reward"]
        seen = self.correction_inputs(latent, action, windows.simulated_next)
        corrected = self.corrected(seen, windows.simulated_next)
        if self.touched is not None:
            correction = (windows.next_state - windows.simulated_next) / self.correction_std
            moved = (correction[..., self.shape.lying_ball].norm(dim=-1) > _TOUCHED).float()  # not as simulated
            logits = self.touched(seen).squeeze(-1)
            bce = functional.binary_cross_entropy_with_logits(logits, moved, reduction="none")
            parts["touched"] = _masked_mean(bce, mask)
            total = total + parts["touched"]
        error = ((corrected - windows.next_state) / self.correction_std)[..., : self.corrected_size].square().mean(-1)
        parts["state"] = _masked_mean(error, mask)
        return total + parts["state"], parts

    @torch.no_grad()
    def _following_latent(self, inputs: Tensor) -> Tensor:
        """Return the next latents (B, T - 1, Z) by the slow encoder; else a constant would be best."""
        return self.target_encoder.sequence(inputs)[0][:, 1:]


def recorded_rewards(windows: PairedWindows) -> Tensor:
    """Return the recorded rewards (B, T, R), see `GroundingModel.set_reward_scales`."""
    if windows.own_reward is None:
        return windows.reward.unsqueeze(-1)
    return torch.stack([windows.reward, windows.reward - windows.own_reward], dim=-1)


def _masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of the values where the mask is 1; 0 where it is nowhere, as in a small batch."""
    return (values * mask).sum() / mask.sum().clamp_min(1.0)


@torch.no_grad()
def telemetry(model: GroundingModel, episodes: PairedEpisodes, weights: LossWeights) -> dict[str, float | None]:
    """Return R² of each trained head on `episodes`, None without variance."""
    windows = episodes.windows
    latent, _ = model.encode(windows)
    mask = windows.mask.bool()
    if not latent[mask].isfinite().all():
        raise BadInputError("the fit diverged: lower learning_rate in [ground], or look at the data's values")
    corrected = model.correct(latent, windows.action, windows.simulated_next)
    figures: dict[str, float | None] = {"r2_state": correction_r2(corrected, windows, model)}
    if weights.reward > 0:
        known = windows.goes_on.bool() & mask
        predicted, true = model.rewards(latent, windows.action)[known], recorded_rewards(windows)[known]
        figures["r2_reward"] = _r2(predicted[:, 0], true[:, 0])
    if weights.latent > 0:
        mean, _ = model.predict_latent(latent[:, :-1], windows.action[:, :-1])
        both = mask[:, :-1] & mask[:, 1:]
        figures["r2_latent"] = _r2(mean[both], latent[:, 1:][both])
    return figures


def correction_r2(corrected: Tensor, windows: PairedWindows, model: GroundingModel) -> float | None:
    """Return the share of squared error in units of the data that `corrected` (B, T, X) removes, if there is any."""
    mask, size = windows.mask.bool(), model.corrected_size
    errors = ((one - windows.next_state) / model.correction_std for one in (corrected, windows.simulated_next))
    wrong, raw = (error[mask][:, :size].square().sum() for error in errors)
    return _explained(wrong, raw)


def _r2(predicted: Tensor, true: Tensor) -> float | None:
    return _explained((predicted - true).square().sum(), (true - true.mean(0)).square().sum())


def _explained(residual: Tensor, total: Tensor) -> float | None:
    return float(1.0 - residual / total) if total > 0 else None
