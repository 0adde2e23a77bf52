"""A differentiable causal model: a network that learns which of its inputs each output depends on.

After Huang et al., "What Went Wrong? Closing the Sim-to-Real Gap via Differentiable Causal Discovery" (CoRL
2023).
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import elu

from astra_data.core.config import AtOnce, Config, Count, NotNegative, Positive, Share

_HIDDEN_SIZE, _FEATURE_SIZE = 64, 32

_STEPS = 200
"""Gradient steps that move causes."""


class CausalConfig(Config):
    """How a causal model is fitted; `sparsity` and `mask_threshold` are its authors'."""

    updates: Count = 1000
    """Gradient updates per fit."""
    batch_size: AtOnce = 128
    """Samples per update."""
    learning_rate: Positive = 3e-3
    """Learning rate of the networks."""
    mask_learning_rate: Positive = 0.03
    """Learning rate of the mask."""
    sparsity: NotNegative = 0.01
    """Weight of the mean probability of the masks."""
    mask_threshold: Share = 0.3
    """A cause counts if the probability of its mask is above this."""


class CausalModel(nn.Module):
    """Predict y_j = d(Σ_i m_ij e(x_i, i), j), where the mask m has a 1 where cause i reaches effect j.

    The networks e and d are shared by all causes and all effects, each of which has a learned embedding.

    Attributes:
        logits: of the mask's probabilities, (I, J).
    """

    def __init__(self, causes: int, effects: int) -> None:
        super().__init__()
        self.logits = nn.Parameter(torch.full((causes, effects), 3.0))
        self.cause_code = nn.Parameter(torch.randn(causes, _HIDDEN_SIZE))
        self.cause_weight = nn.Parameter(torch.randn(_HIDDEN_SIZE))
        self.encoder = nn.Linear(_HIDDEN_SIZE, _FEATURE_SIZE)
        self.effect_code = nn.Parameter(torch.randn(effects, _HIDDEN_SIZE))
        self.decoder = nn.Linear(_FEATURE_SIZE, _HIDDEN_SIZE)
        self.output = nn.Linear(_HIDDEN_SIZE, 1)

    @property
    def probability(self) -> Tensor:
        """The probability that a cause reaches an effect, (I, J)."""
        return self.logits.sigmoid()

    def draw_mask(self, count: int) -> Tensor:
        """Draw masks (count, I, J) of zeros and ones, from torch's global generator.

        Their gradient is that of the relaxed draw (straight-through Gumbel sigmoid, temperature 1).
        """
        uniform = torch.rand(count, *self.logits.shape, device=self.logits.device).clamp(1e-6, 1.0 - 1e-6)
        soft = (self.logits + uniform.logit()).sigmoid()
        return (soft > 0.5).float() + (soft - soft.detach())

    def forward(self, cause: Tensor, mask: Tensor) -> Tensor:
        """Return the effects (B, J) of causes (B, I) under masks (B, I, J) or (I, J)."""
        feature = self.encoder(elu(cause.unsqueeze(-1) * self.cause_weight + self.cause_code))
        reaching = mask.transpose(-1, -2) @ feature
        effect: Tensor = self.output(elu(self.decoder(reaching) + self.effect_code)).squeeze(-1)
        return effect


def fit_causes(cause: Tensor, effect: Tensor, config: CausalConfig, *, penalized: int) -> CausalModel:
    """Fit a causal model to causes (N, I) and effects (N, J), these of mean 0 and deviation 1; freeze it.

    All randomness comes from torch's global generator.

    Args:
        cause: scaled to about one.
        effect: normalized.
        config: the settings.
        penalized: the masks of the first so many causes are to be sparse.
    """
    model = CausalModel(cause.shape[1], effect.shape[1]).to(cause.device)
    networks = [weight for name, weight in model.named_parameters() if name != "logits"]
    optimizer = torch.optim.Adam(
        [
            {"params": networks, "lr": config.learning_rate},
            {"params": [model.logits], "lr": config.mask_learning_rate},
        ]
    )
    for _ in range(config.updates):
        rows = torch.randint(len(cause), (config.batch_size,), device=cause.device)
        wrong = model(cause[rows], model.draw_mask(config.batch_size)) - effect[rows]
        loss = wrong.square().mean() + config.sparsity * model.probability[:penalized].mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return model.requires_grad_(False)


def descend(model: CausalModel, mask: Tensor, start: Tensor, moves: Tensor, others: Tensor) -> Tensor:
    """Move causes to where a frozen model expects the smallest effects, in the mean over samples.

    Args:
        model: the model.
        mask: which causes reach which effects, (I, J).
        start: the first P causes, the same in all samples, in [-1, 1].
        moves: which of them are moved, (P,) bool.
        others: the other causes of N samples, (N, I - P).

    Returns:
        the moved causes (P,), in [-1, 1].
    """
    causes = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([causes], lr=0.02)
    for _ in range(_STEPS):
        optimizer.zero_grad()
        expected = model(torch.cat([causes.expand(len(others), -1), others], dim=-1), mask).mean()
        (gradient,) = torch.autograd.grad(expected, causes)
        causes.grad = gradient * moves
        optimizer.step()
        with torch.no_grad():
            causes.clamp_(-1.0, 1.0)
    return causes.detach()
