"""The target encoder ψ^t and the discrepancy that aligns it with the source encoder (paper, Section IV-B)."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from astra_data.core.arrays import normalized
from astra_data.grounding.encoder import ENCODERS, HistoryEncoder, PositionFeatures, take_scales

_UNIT = 1e-3  # tolerance of lengths of 1
LEAST_LATENT_R2 = 0.9  # of a target encoder on held-out episodes, to be deployed in place of the source encoder


class TargetEncoder(nn.Module):
    """ψ^t: encode target states into the source encoder's latents; `sizes` are its arguments.

    With `sensing` it reads "inputs", sizes of columns by name, in the place of a state, and a second encoder of the
    same kind estimates φ(s), so that a robot runs without tracking: "abstract_size" and "unit_vectors" are those of
    φ(s). "pictures" says of columns of features which camera and which encoder they come from.
    """

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
        sensing: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        alike = {"embedding_size": embedding_size, "latent_size": latent_size}
        self.sizes: dict[str, Any] = {"state_size": state_size, "goal_size": goal_size, "action_size": action_size}
        self.sizes |= {**alike, "position_octaves": position_octaves, "encoder": encoder}
        self.position_features = PositionFeatures(position_octaves)
        input_size = state_size + self.position_features.size + goal_size + action_size
        self.encoder = ENCODERS[encoder](input_size, **alike)
        self.inputs: dict[str, int] = sensing["inputs"] if sensing else {}
        if sensing:
            self.sizes["sensing"], size = sensing, sensing["abstract_size"]
            self.pictures, self.unit_vectors = sensing["pictures"], sensing["unit_vectors"]
            self.estimator, self.estimate_head = ENCODERS[encoder](input_size, **alike), nn.Linear(latent_size, size)
            self.estimate_now = nn.Linear(input_size, size)  # of the inputs, which a memory keeps coarsely
            for parameter in self.estimate_now.parameters():
                nn.init.zeros_(parameter)
            self.abstract_mean, self.abstract_std = nn.Buffer(torch.zeros(size)), nn.Buffer(torch.ones(size))
        self.state_mean, self.state_std = nn.Buffer(torch.zeros(state_size)), nn.Buffer(torch.ones(state_size))
        self.goal_mean, self.goal_std = nn.Buffer(torch.zeros(goal_size)), nn.Buffer(torch.ones(goal_size))
        self.latent_r2 = nn.Buffer(torch.zeros(()))
        """Share of the variance of ψ^s's latents that it explains on held-out episodes."""

    @property
    def is_deployed(self) -> bool:
        """Whether robots run with ψ^t by default; where it is coarse, they run with ψ^s on φ(s)."""
        return bool(self.latent_r2 >= LEAST_LATENT_R2)

    def set_scales(
        self, state: Tensor, goal: Tensor, unseen: Sequence[int] = (), abstract: Tensor | None = None
    ) -> None:
        """Take scales of `state` (N, S), `goal` (N, G), φ (N, X); the entries `unseen` are then always 0 as inputs."""
        take_scales(self, {"state": state, "goal": goal} | ({} if abstract is None else {"abstract": abstract}))
        self.state_std[list(unseen)] = torch.inf

    def estimates(self, read: Tensor, memory: Tensor) -> Tensor:
        """Return φ(s) (..., X) as estimated from `encoder_input` (..., I) and the memory (..., M) that includes it."""
        normal = self.estimate_head(self.estimator.latent(memory)) + self.estimate_now(read)
        abstract: Tensor = self.abstract_mean + self.abstract_std * normal
        for first, end in self.unit_vectors:
            vector = functional.normalize(abstract[..., first:end], dim=-1)
            abstract = torch.cat([abstract[..., :first], vector, abstract[..., end:]], dim=-1)
        return abstract

    def encoder_input(self, state: Tensor, goal: Tensor, previous_action: Tensor) -> Tensor:
        """Assemble [s_i, features of its position, goal, a_{i-1}] (..., I)."""
        normal_state = normalized(state, self.state_mean, self.state_std)
        waves = self.position_features(state[..., :2])
        normal_goal = normalized(goal, self.goal_mean, self.goal_std)
        return torch.cat([normal_state, waves, normal_goal, previous_action], dim=-1)


def unit_vectors(abstract: Tensor) -> list[tuple[int, int]]:
    """Return first and end of 2 or 4 neighbors in states (N, X) whose length is always 1, such as cos and sin."""
    spans = [(first, first + width) for width in (2, 4) for first in range(abstract.shape[1] - width + 1)]
    return [(a, b) for a, b in spans if ((abstract[:, a:b].norm(dim=1) - 1.0).abs() < _UNIT).all()]


def gaussian_mmd(mean_1: Tensor, variance_1: Tensor, mean_2: Tensor, variance_2: Tensor, bandwidths: Tensor) -> Tensor:
    """Return the squared MMD (...) of diagonal Gaussians (..., Z) with Gaussian kernels of `bandwidths` (K,)."""
    # Relative to the bandwidths, which takes fewer operations on (..., K, Z), where the time goes.
    inverse = bandwidths.square().reciprocal().unsqueeze(-1)
    apart = (mean_1 - mean_2).square().unsqueeze(-2) * inverse

    def mean_kernel(variance: Tensor, *, is_own: bool) -> Tensor:
        spread = 1.0 + variance.unsqueeze(-2) * inverse
        exponent = spread.log() if is_own else spread.log() + apart / spread
        return (-0.5 * exponent.sum(-1)).exp().mean(-1)

    return (
        mean_kernel(2.0 * variance_1, is_own=True)
        + mean_kernel(2.0 * variance_2, is_own=True)
        - 2.0 * mean_kernel(variance_1 + variance_2, is_own=False)
    )
