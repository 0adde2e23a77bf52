"""Gaussian actor and critic, with or without a recurrent memory of their own."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from astra_data.grounding.networks.history import mlp
from astra_data.policies.networks.policy import Policy, PolicyShape


@dataclass(frozen=True)
class ActorCriticShape(PolicyShape):
    """Sizes of actor and critic, and their actions.

    Attributes:
        initial_log_std: logarithm of the initial standard deviation.
    """

    initial_log_std: float = -0.5


def bounded(output: Tensor) -> Tensor:
    """Return the mean actions (..., A) of an actor's `output`, clipped to ±1 with the gradient of the output.

    A tanh is flat far out: once a policy pushes against a wall at full speed, it hardly learns to turn.
    """
    return output + (output.clamp(-1.0, 1.0) - output).detach()


class ActorCritic(Policy):
    """Bounded Gaussian mean with a state-independent deviation, and a value."""

    shape: ActorCriticShape

    def __init__(self, shape: ActorCriticShape) -> None:
        super().__init__(shape)
        self.actor = mlp((shape.feature_size, *shape.hidden_sizes, shape.action_size), inplace=True)
        self.critic = mlp((shape.feature_size, *shape.hidden_sizes, 1), inplace=True)
        self.log_std = nn.Parameter(torch.full((shape.action_size,), shape.initial_log_std))
        for network, gain in ((self.actor, 0.01), (self.critic, 1.0)):
            layers = [layer for layer in network if isinstance(layer, nn.Linear)]
            for layer in layers:
                nn.init.orthogonal_(layer.weight, 2**0.5)
                nn.init.zeros_(layer.bias)
            nn.init.orthogonal_(layers[-1].weight, gain)

    @property
    def value_layer(self) -> nn.Linear:
        """The critic's last layer."""
        layer = self.critic[-1]
        assert isinstance(layer, nn.Linear)
        return layer

    def policy(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation (..., A) of the action for `features` (..., F)."""
        return self.gaussian(self.actor(features))

    def gaussian(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation (..., A) of the action for the actor's `output` (..., A)."""
        mean = bounded(output)
        return mean, self.log_std.exp().expand_as(mean)

    def act(self, features: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the mean action (..., A), or with `generator` a sample that is clipped to ±1."""
        mean, std = self.policy(features)
        return mean if generator is None else torch.normal(mean, std, generator=generator).clamp(-1.0, 1.0)

    def value(self, features: Tensor) -> Tensor:
        """Return the value (...) of `features` (..., F)."""
        return torch.as_tensor(self.critic(features).squeeze(-1))
