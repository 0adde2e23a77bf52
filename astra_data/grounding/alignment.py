"""The target encoder ψ^t and the discrepancy that aligns it with the source encoder (paper, Section IV-B)."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from astra_data.core.arrays import normalized
from astra_data.grounding.encoder import ENCODERS, HistoryEncoder, PositionFeatures, take_scales

LEAST_LATENT_R2 = 0.9  # of a target encoder on held-out episodes, to be deployed in place of the source encoder


class TargetEncoder(nn.Module):
    """ψ^t: encode full target states into the source encoder's latents; `sizes` are its arguments."""

    def __init__(
        self,
        state_size: int,
        goal_size: int,
        action_size: int,
        *,
        embedding_size: int,
        latent_size: int,
        position_octaves: int = 4,
        encoder: str = HistoryEncoder.kind,
    ) -> None:
        super().__init__()
        self.sizes: dict[str, Any] = {"state_size": state_size, "goal_size": goal_size, "action_size": action_size}
        self.sizes |= {"embedding_size": embedding_size, "latent_size": latent_size}
        self.sizes |= {"position_octaves": position_octaves}
        if encoder != HistoryEncoder.kind:
            self.sizes["encoder"] = encoder
        self.position_features = PositionFeatures(position_octaves)
        self.encoder = ENCODERS[encoder](
            state_size + self.position_features.size + goal_size + action_size,
            embedding_size=embedding_size,
            latent_size=latent_size,
        )
        self.state_mean, self.state_std = nn.Buffer(torch.zeros(state_size)), nn.Buffer(torch.ones(state_size))
        self.goal_mean, self.goal_std = nn.Buffer(torch.zeros(goal_size)), nn.Buffer(torch.ones(goal_size))
        self.latent_r2 = nn.Buffer(torch.zeros(()))
        """Share of the variance of ψ^s's latents that it explains on held-out episodes."""

    @property
    def is_deployed(self) -> bool:
        """Whether robots run with ψ^t by default; where it is coarse, they run with ψ^s on φ(s)."""
        return bool(self.latent_r2 >= LEAST_LATENT_R2)

    def set_scales(self, state: Tensor, goal: Tensor, unseen: Sequence[int] = ()) -> None:
        """Take scales of `state` (N, S) and `goal` (N, G); the entries `unseen` are then always 0 as inputs."""
        take_scales(self, {"state": state, "goal": goal})
        self.state_std[list(unseen)] = torch.inf

    def encoder_input(self, state: Tensor, goal: Tensor, previous_action: Tensor) -> Tensor:
        """Assemble [s_i, features of its position, goal, a_{i-1}] (..., I)."""
        normal_state = normalized(state, self.state_mean, self.state_std)
        waves = self.position_features(state[..., :2])
        normal_goal = normalized(goal, self.goal_mean, self.goal_std)
        return torch.cat([normal_state, waves, normal_goal, previous_action], dim=-1)


def gaussian_mmd(mean_1: Tensor, variance_1: Tensor, mean_2: Tensor, variance_2: Tensor, bandwidths: Tensor) -> Tensor:
    """Return the squared MMD (...) of diagonal Gaussians (..., Z) with Gaussian kernels of `bandwidths` (K,)."""
    squared = bandwidths.square().unsqueeze(-1)
    apart = (mean_1 - mean_2).square().unsqueeze(-2)

    def mean_kernel(variance: Tensor, *, is_own: bool) -> Tensor:
        spread = squared + variance.unsqueeze(-2)
        exponent = (squared / spread).log()
        if not is_own:
            exponent = exponent - apart / spread
        return (0.5 * exponent.sum(-1)).exp().mean(-1)

    return (
        mean_kernel(2.0 * variance_1, is_own=True)
        + mean_kernel(2.0 * variance_2, is_own=True)
        - 2.0 * mean_kernel(variance_1 + variance_2, is_own=False)
    )
