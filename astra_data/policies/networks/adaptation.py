"""Rapid motor adaptation (Kumar et al. 2021): policies that act on extrinsics.

Extrinsics encode those parameters of the environment that matter. The teacher observes the parameters and
encodes them; the student estimates the same extrinsics from its observations and actions.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from astra_data.grounding.networks.history import mlp
from astra_data.policies.networks.actor_critic import ActorCritic, ActorCriticShape

SHORTEST_HISTORY = 40
"""Steps that the student's convolutions span."""


@dataclass(frozen=True)
class AdaptiveShape(ActorCriticShape):
    """Sizes of teacher and student.

    Attributes:
        extrinsics_size: E. history_length: H, steps that the student's estimate is made from.
    """

    extrinsics_size: int = 8
    history_length: int = 50

    @property
    def feature_size(self) -> int:
        """F, size of the input of actor and critic: observation, memory and extrinsics."""
        return super().feature_size + self.extrinsics_size


class Teacher(ActorCritic):
    """Actor and critic that observe the environment's parameters, as the last P values of observations."""

    shape: AdaptiveShape

    def __init__(self, shape: AdaptiveShape, parameter_count: int) -> None:
        super().__init__(shape)
        sizes = (parameter_count, *shape.hidden_sizes, shape.extrinsics_size)
        self.encoder = nn.Sequential(*mlp(sizes), nn.Tanh())

    def extrinsics(self, observation: Tensor) -> Tensor:
        """Encode the parameters in `observation` (..., O + P); return extrinsics (..., E) in [-1, 1]."""
        return torch.as_tensor(self.encoder(observation[..., self.shape.observation_size :]))

    def remember(self, observation: Tensor, previous_action: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Process one step `observation` (B, O + P); return features (B, F) and the next hidden (B, M)."""
        seen = observation[:, : self.shape.observation_size]
        features, hidden = super().remember(seen, previous_action, hidden)
        return torch.cat([features, self.extrinsics(observation)], dim=-1), hidden

    def remember_sequence(
        self, observation: Tensor, previous_action: Tensor, hidden: Tensor, start: Tensor
    ) -> Tensor:
        """Return the features (B, T, F) of `observation` (B, T, O + P); see `Policy`."""
        seen = observation[..., : self.shape.observation_size]
        features = super().remember_sequence(seen, previous_action, hidden, start)
        return torch.cat([features, self.extrinsics(observation)], dim=-1)


class HistoryEstimate(nn.Module):
    """Estimate extrinsics from H rows of I values each, with the convolutions of Kumar et al. 2021."""

    def __init__(self, row_size: int, length: int, extrinsics_size: int) -> None:
        super().__init__()
        self.length = length
        self.embedding = nn.Linear(row_size, 32)
        self.convolutions = nn.Sequential(
            nn.Conv1d(32, 32, 8, stride=4), nn.ELU(), nn.Conv1d(32, 32, 5), nn.ELU(), nn.Conv1d(32, 32, 5)
        )
        moments = (length - SHORTEST_HISTORY) // 4 + 1
        self.head = nn.Linear(32 * moments, extrinsics_size)

    def forward(self, history: Tensor) -> Tensor:
        """Return extrinsics (B, E), in [-1, 1], for `history` (B, H * I), the newest row last."""
        embedded = functional.elu(self.embedding(history.unflatten(-1, (self.length, -1))))
        seen = functional.elu(self.convolutions(embedded.transpose(1, 2)))
        return torch.tanh(self.head(seen.flatten(1)))


class Student(ActorCritic):
    """Actor and critic with extrinsics that are estimated from the last H observations and actions.

    The hidden state is the memory (B, M) followed by the history (B, H * (O + A)): each row holds an
    observation and the action before it, the newest last; rows from before the start are zero.
    """

    shape: AdaptiveShape

    def __init__(self, shape: AdaptiveShape) -> None:
        super().__init__(shape)
        row_size = shape.observation_size + shape.action_size
        self.adaptation = HistoryEstimate(row_size, shape.history_length, shape.extrinsics_size)

    @classmethod
    def of_teacher(cls, teacher: Teacher) -> "Student":
        """Return a student with the teacher's frozen memory, actor and critic, and an untrained estimate."""
        student = cls(teacher.shape).to(teacher.log_std.device)
        shared = student.state_dict().keys() & teacher.state_dict().keys()
        student.load_state_dict({name: teacher.state_dict()[name] for name in shared}, strict=False)
        student.requires_grad_(False)
        student.adaptation.requires_grad_(True)
        return student

    def initial_hidden(self, count: int) -> Tensor:
        """Return memory and history (count, M + H * (O + A)) at the start of an episode: zeros."""
        shape = self.shape
        history = shape.history_length * (shape.observation_size + shape.action_size)
        return torch.zeros(count, shape.memory_size + history, device=self.log_std.device)

    def remember(self, observation: Tensor, previous_action: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Process one step; return the features (B, F), the estimate last, and the next hidden."""
        memory, history = hidden.tensor_split([self.shape.memory_size], dim=-1)
        features, memory = super().remember(observation, previous_action, memory)
        newest = torch.cat([observation, previous_action], dim=-1)
        history = torch.cat([history[:, newest.shape[1] :], newest], dim=-1)
        features = torch.cat([features, self.adaptation(history)], dim=-1)
        return features, torch.cat([memory, history], dim=-1)

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
