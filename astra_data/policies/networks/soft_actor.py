"""The policy of soft actor-critic: a Gaussian whose samples are squashed by tanh."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from astra_data.grounding.networks.history import mlp
from astra_data.policies.networks.policy import Policy, PolicyShape, gaussian_log_prob

_SMALLEST_SCALE = 1e-3
_UNIT_SCALE = math.log(math.e - 1.0)
"""Its softplus is 1."""


class SoftActor(Policy):
    """A Gaussian whose location and scale both depend on the features; actions are the tanh of samples."""

    squashes = True

    def __init__(self, shape: PolicyShape) -> None:
        super().__init__(shape)
        self.actor = mlp((shape.feature_size, *shape.hidden_sizes, 2 * shape.action_size), nn.ReLU)

    def policy(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale (..., A) of the Gaussian, before the tanh, for `features` (..., F)."""
        loc, width = self.actor(features).chunk(2, dim=-1)
        return loc, functional.softplus(width + _UNIT_SCALE) + _SMALLEST_SCALE

    def sample(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Draw actions (..., A), through which gradients flow; return them and their log-density (...)."""
        loc, scale = self.policy(features)
        drawn = loc + scale * torch.randn_like(loc)
        # log(1 - tanh²), without loss of precision far out.
        narrowed = 2.0 * (math.log(2.0) - drawn - functional.softplus(-2.0 * drawn))
        return torch.tanh(drawn), gaussian_log_prob(loc, scale, drawn) - narrowed.sum(-1)

    def act(self, features: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the tanh of the location, (..., A), or with `generator` that of a sample."""
        loc, scale = self.policy(features)
        return torch.tanh(loc if generator is None else torch.normal(loc, scale, generator=generator))
