"""Rapid motor adaptation (Kumar et al. 2021): policies that act on extrinsics.

Extrinsics are what matters of a world's parameters. The teacher is told the parameters and encodes them; the
student estimates the same extrinsics from what it has seen and done.
"""

from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

from astra_data.models.actor_critic import ActorCritic, ActorCriticShape
from astra_data.models.history import mlp

SHORTEST_HISTORY = 40
"""Steps that the student's convolutions span."""


@dataclass(frozen=True)
class AdaptiveShape(ActorCriticShape):
    """Sizes of teacher and student.

    Attributes:
        observation_size: O, of what the student sees, too. extrinsics_size: E.
        history_length: H, steps that the student's estimate looks back.
    """

    extrinsics_size: int = 8
    history_length: int = 50

    @property
    def feature_size(self) -> int:
        """F, of what actor and critic see: an observation and extrinsics."""
        return self.observation_size + self.extrinsics_size


class Teacher(ActorCritic):
    """Actor and critic that are told their world's parameters: the last P values of what they observe."""

    def __init__(self, shape: AdaptiveShape, parameter_count: int) -> None:
        super().__init__(shape)
        sizes = (parameter_count, *shape.hidden_sizes, shape.extrinsics_size)
        self.encoder = nn.Sequential(*mlp(sizes), nn.Tanh())

    def extrinsics(self, told: Tensor) -> Tensor:
        """Encode the parameters in `told` (..., O + P); return extrinsics (..., E) in [-1, 1]."""
        return torch.as_tensor(self.encoder(told[..., self.shape.observation_size :]))

    def remember(self, observation: Tensor, previous_action: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Return the features (B, F) for `observation` (B, O + P); there is no memory."""
        return self._features(observation), hidden

    def remember_sequence(
        self, observation: Tensor, previous_action: Tensor, hidden: Tensor, start: Tensor
    ) -> Tensor:
        """Return the features (B, T, F) for `observation` (B, T, O + P)."""
        return self._features(observation)

    def _features(self, told: Tensor) -> Tensor:
        return torch.cat([told[..., : self.shape.observation_size], self.extrinsics(told)], dim=-1)


class Student(ActorCritic):
    """Actor and critic with extrinsics that are estimated from the last H observations and actions.

    The hidden state (B, H * (O + A)) holds them: in each row an observation and the action before it, the
    newest last, zeros for what was before the start. The convolutions are those of Kumar et al. 2021.
    """

    shape: AdaptiveShape

    def __init__(self, shape: AdaptiveShape) -> None:
        super().__init__(shape)
        self.embedding = nn.Linear(shape.observation_size + shape.action_size, 32)
        self.convolutions = nn.Sequential(
            nn.Conv1d(32, 32, 8, stride=4), nn.ELU(), nn.Conv1d(32, 32, 5), nn.ELU(), nn.Conv1d(32, 32, 5)
        )
        moments = (shape.history_length - SHORTEST_HISTORY) // 4 + 1
        self.head = nn.Linear(32 * moments, shape.extrinsics_size)

    @classmethod
    def of_teacher(cls, teacher: Teacher) -> "Student":
        """Return a student with the frozen actor and critic of `teacher`, and an untrained estimate."""
        own = {field.name: getattr(teacher.shape, field.name) for field in fields(AdaptiveShape)}
        student = cls(AdaptiveShape(**own)).to(teacher.log_std.device)
        for name in ("actor", "critic"):
            getattr(student, name).load_state_dict(getattr(teacher, name).state_dict())
            getattr(student, name).requires_grad_(False)
        student.log_std.data.copy_(teacher.log_std.data)
        student.log_std.requires_grad_(False)
        return student

    def estimate(self, hidden: Tensor) -> Tensor:
        """Return the extrinsics (B, E), in [-1, 1], that the last steps `hidden` tell of."""
        rows = hidden.unflatten(-1, (self.shape.history_length, -1))
        embedded = nn.functional.elu(self.embedding(rows)).transpose(1, 2)
        seen = nn.functional.elu(self.convolutions(embedded)).flatten(1)
        return torch.tanh(self.head(seen))

    def initial_hidden(self, count: int) -> Tensor:
        """Return the history (count, H * (O + A)) at the start of an episode: nothing."""
        size = self.shape.history_length * self.embedding.in_features
        return torch.zeros(count, size, device=self.log_std.device)

    def remember(self, observation: Tensor, previous_action: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Take in one step; return the features (B, F) and the history that ends with it."""
        newest = torch.cat([observation, previous_action], dim=-1)
        hidden = torch.cat([hidden[:, newest.shape[1] :], newest], dim=-1)
        return torch.cat([observation, self.estimate(hidden)], dim=-1), hidden

    def remember_sequence(
        self, observation: Tensor, previous_action: Tensor, hidden: Tensor, start: Tensor
    ) -> Tensor:
        """Return the features (B, T, F) of T steps, from `hidden`; `start` (B, T) is 1 at new episodes."""
        features = []
        for step in range(observation.shape[1]):
            hidden = hidden * (1.0 - start[:, step, None])
            seen, hidden = self.remember(observation[:, step], previous_action[:, step], hidden)
            features.append(seen)
        return torch.stack(features, dim=1)
