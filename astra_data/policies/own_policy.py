"""Policies of other learners, which act on the observations of a row's environment."""

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.policies.networks.policy import Policy, PolicyShape
from astra_data.worlds.own_code import explained

Array = NDArray[Any]


class ActingPolicy(Protocol):
    """What a policy of another learner has to have."""

    def act(self, observation: Array) -> Array:
        """Return actions (B, A) within ±1 for observations (B, O) float32."""
        ...


class SavedPolicy(ActingPolicy, Protocol):
    """What a policy has to have that a learner of the user's makes for a row.

    Attributes:
        kind: names the class in files; see `KINDS`.
    """

    kind: ClassVar[str]

    def to_file(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        """Return tensors, at least one, and metadata (JSON values) from which `from_file` rebuilds it."""
        ...

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any]) -> Self:
        """Rebuild it."""
        ...


KINDS: dict[str, type[SavedPolicy]] = {}
"""The classes of such policies by their kinds, as methods of the user's add them."""


class OwnPolicy(Policy):
    """A policy of another learner, in the place of one that was trained here; it has no memory."""

    def __init__(self, acting: ActingPolicy, observation_size: int, action_size: int) -> None:
        """Let `acting` act on observations (B, O).

        Raises:
            BadInputError: it has no `act`.
        """
        super().__init__(PolicyShape(observation_size, action_size))
        if not callable(getattr(acting, "act", None)):
            raise BadInputError(f"{type(acting).__name__} is no policy: expected act(observation) -> action")
        self.acting = acting

    @property
    def name(self) -> str:
        """The name of its class."""
        return type(self.acting).__name__

    def initial_hidden(self, count: int) -> Tensor:
        """Return no memory, (count, 0)."""
        return torch.zeros(count, 0)

    def policy(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actions (B, A) for observations (B, O), and a scale of 0."""
        action = self.act(features)
        return action, torch.zeros_like(action)

    def act(self, features: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the actions (B, A), clipped to ±1, for observations (B, O); `generator` has no effect.

        Raises:
            BadInputError: the policy fails, or returns something of another shape, or that is not finite.
        """
        with explained(f"{self.name}.act"):
            action = np.asarray(self.acting.act(features.numpy()), dtype=np.float32)
        expected = (len(features), self.shape.action_size)
        if action.shape != expected:
            raise BadInputError(f"{self.name}.act: expected actions of shape {expected}, got {action.shape}")
        if not np.isfinite(action).all():
            raise BadInputError(f"{self.name}.act: expected finite actions, got NaN or infinity")
        return torch.from_numpy(action).clamp(-1.0, 1.0)
