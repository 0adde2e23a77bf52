"""The policy and its value: Gaussian actor and critic, with or without a recurrent memory of their own."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from astra_data.models.history import HistoryEncoder, mlp


@dataclass(frozen=True)
class ActorCriticShape:
    """Sizes of actor and critic.

    Attributes:
        observation_size: O. action_size: A. memory_size: of the GRU that encodes (observation, previous
            action); 0 for none, where the observation already holds a latent.
    """

    observation_size: int
    action_size: int
    memory_size: int = 0
    embedding_size: int = 64
    hidden_sizes: tuple[int, ...] = (64, 64)
    initial_log_std: float = -0.5

    @property
    def feature_size(self) -> int:
        """F, of what actor and critic see."""
        return self.observation_size + self.memory_size


class ActorCritic(nn.Module):
    """Tanh-bounded Gaussian mean with a state-independent deviation, and a value.

    Memory is handed in and out as `hidden` (B, M), never kept; without memory M = 0.
    """

    def __init__(self, shape: ActorCriticShape) -> None:
        super().__init__()
        self.shape = shape
        self.memory: HistoryEncoder | None = None
        if shape.memory_size:
            self.memory = HistoryEncoder(
                shape.observation_size + shape.action_size,
                embedding_size=shape.embedding_size,
                latent_size=shape.memory_size,
            )
        self.actor = mlp((shape.feature_size, *shape.hidden_sizes, shape.action_size))
        self.critic = mlp((shape.feature_size, *shape.hidden_sizes, 1))
        self.log_std = nn.Parameter(torch.full((shape.action_size,), shape.initial_log_std))
        for network, gain in ((self.actor, 0.01), (self.critic, 1.0)):
            layers = [layer for layer in network if isinstance(layer, nn.Linear)]
            for layer in layers:
                nn.init.orthogonal_(layer.weight, 2**0.5)
                nn.init.zeros_(layer.bias)
            nn.init.orthogonal_(layers[-1].weight, gain)

    def initial_hidden(self, count: int) -> Tensor:
        """Return the memory (count, M) at the start of an episode."""
        return torch.zeros(count, self.shape.memory_size, device=self.log_std.device)

    def remember(self, observation: Tensor, previous_action: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Take in one step; return the features (B, F) for actor and critic, and the next hidden (B, M)."""
        if self.memory is None:
            return observation, hidden
        hidden = self.memory.step(torch.cat([observation, previous_action], dim=-1), hidden)
        return torch.cat([observation, self.memory.latent(hidden)], dim=-1), hidden

    def remember_sequence(
        self, observation: Tensor, previous_action: Tensor, hidden: Tensor, start: Tensor
    ) -> Tensor:
        """Return the features (B, T, F) of `observation` (B, T, O), (B, T, A), from `hidden` (B, M).

        `start` (B, T) is 1 where a new episode begins: there the memory is emptied.
        """
        if self.memory is None:
            return observation
        inputs = torch.cat([observation, previous_action], dim=-1)
        keep = 1.0 - start.unsqueeze(-1)
        states = []
        for step in range(inputs.shape[1]):
            hidden = self.memory.step(inputs[:, step], hidden * keep[:, step])
            states.append(hidden)
        return torch.cat([observation, self.memory.latent(torch.stack(states, dim=1))], dim=-1)

    def policy(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation (..., A) of the action for `features` (..., F)."""
        mean = torch.tanh(self.actor(features))
        return mean, self.log_std.exp().expand_as(mean)

    def value(self, features: Tensor) -> Tensor:
        """Return the value (...) of `features` (..., F)."""
        return torch.as_tensor(self.critic(features).squeeze(-1))
