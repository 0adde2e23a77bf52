"""The base of all policies: a recurrent memory where observations hold no latent, and a head that acts."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from astra_data.grounding.networks.history import HistoryEncoder

_SMALLEST_SQUASHED = 1e-6 - 1.0
"""Actions beyond it are taken for it, since the tanh of no number is -1."""


@dataclass(frozen=True)
class PolicyShape:
    """Sizes of a policy.

    Attributes:
        observation_size: O. action_size: A. memory_size: M, of the GRU that encodes (observation, previous
            action); 0 for none, where the observation already holds a latent.
    """

    observation_size: int
    action_size: int
    memory_size: int = 0
    embedding_size: int = 64
    hidden_sizes: tuple[int, ...] = (64, 64)

    @property
    def feature_size(self) -> int:
        """F, size of the input of the heads: the observation and the memory."""
        return self.observation_size + self.memory_size

    def new_memory(self) -> HistoryEncoder | None:
        """Build an untrained memory; None where there is none."""
        if not self.memory_size:
            return None
        return HistoryEncoder(
            self.observation_size + self.action_size,
            embedding_size=self.embedding_size,
            latent_size=self.memory_size,
        )


def features_of(
    memory: HistoryEncoder | None, observation: Tensor, previous_action: Tensor, hidden: Tensor, start: Tensor
) -> Tensor:
    """Return the features (B, T, F) of `observation` (B, T, O), (B, T, A), from `hidden` (B, M).

    `start` (B, T) is 1 where a new episode begins: there the memory is set to zero.
    """
    if memory is None:
        return observation
    inputs = torch.cat([observation, previous_action], dim=-1)
    return torch.cat([observation, memory.latent(memory.through_episodes(inputs, hidden, start))], dim=-1)


def gaussian_log_prob(mean: Tensor, std: Tensor, value: Tensor) -> Tensor:
    """Return the log-density (...) of `value` (..., A) under independent Gaussians (..., A)."""
    return (((value - mean) / std).square() / -2 - std.log() - math.log(2 * math.pi) / 2).sum(-1)


class Policy(nn.Module, ABC):
    """Acts on observations and its memory of them.

    The memory is an argument and a result, `hidden` (B, M), never kept; without memory M = 0.

    Attributes:
        squashes: whether actions are the tanh of draws from the Gaussian that `policy` returns.
    """

    squashes: ClassVar[bool] = False

    def __init__(self, shape: PolicyShape) -> None:
        super().__init__()
        self.shape = shape
        self.memory = shape.new_memory()

    def initial_hidden(self, count: int) -> Tensor:
        """Return the memory (count, M) at the start of an episode."""
        return torch.zeros(count, self.shape.memory_size, device=next(self.parameters()).device)

    def remember(self, observation: Tensor, previous_action: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Process one step; return the features (B, F), and the next hidden (B, M)."""
        if self.memory is None:
            return observation, hidden
        hidden = self.memory.step(torch.cat([observation, previous_action], dim=-1), hidden)
        return torch.cat([observation, self.memory.latent(hidden)], dim=-1), hidden

    def remember_sequence(
        self, observation: Tensor, previous_action: Tensor, hidden: Tensor, start: Tensor
    ) -> Tensor:
        """Return the features (B, T, F) of T steps; see `features_of`."""
        return features_of(self.memory, observation, previous_action, hidden, start)

    @abstractmethod
    def policy(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale (..., A) of a Gaussian for `features` (..., F)."""

    def log_prob(self, features: Tensor, action: Tensor) -> Tensor:
        """Return the log-density (...) of `action` (..., A) for `features` (..., F)."""
        if not self.squashes:
            return gaussian_log_prob(*self.policy(features), action)
        inside = action.clamp(_SMALLEST_SQUASHED, -_SMALLEST_SQUASHED)
        drawn = gaussian_log_prob(*self.policy(features), inside.atanh())
        return drawn - torch.log1p(-inside.square()).sum(-1)

    @abstractmethod
    def act(self, features: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the action (..., A), within ±1: the mode, or with `generator` a sample."""
