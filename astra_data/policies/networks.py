"""The base of all policies: a recurrent memory where observations hold no latent, and a head that acts."""

import copy
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from astra_data.core.arrays import gaussian_log_prob
from astra_data.core.errors import BadInputError
from astra_data.grounding.encoder import HistoryEncoder, mlp
from astra_data.policies.learner import PACKAGE_KINDS, ActingPolicy
from astra_data.worlds.user_code import explained

_INITIAL_LOG_STD = -0.5  # of the actions of an actor
_LARGEST_REWARD = 10.0  # scaled rewards are clipped to this


@dataclass(frozen=True)
class PolicyShape:
    """Sizes of a policy."""

    observation_size: int  # O
    action_size: int  # A
    memory_size: int = 0
    """M, of the GRU that encodes (observation, previous action); 0 where the observation already holds a latent."""
    embedding_size: int = 64
    hidden_sizes: tuple[int, ...] = (64, 64)

    @property
    def feature_size(self) -> int:
        """F, size of the input of the heads: the observation and the memory."""
        return self.observation_size + self.memory_size


class Remembering(nn.Module):
    """A memory of observations, if there is one: an argument and a result, `hidden` (B, M), never kept."""

    def __init__(self, shape: PolicyShape) -> None:
        super().__init__()
        self.shape = shape
        self.memory: HistoryEncoder | None = None
        if shape.memory_size:
            sizes = {"embedding_size": shape.embedding_size, "latent_size": shape.memory_size}
            self.memory = HistoryEncoder(shape.observation_size + shape.action_size, **sizes)

    def initial_hidden(self, count: int) -> Tensor:
        """Return the memory (count, M) at the start of an episode."""
        return torch.zeros(count, self.shape.memory_size, device=next(self.parameters(), torch.empty(0)).device)

    def remember_sequence(self, observation: Tensor, previous_action: Tensor, hidden: Tensor, start: Tensor) -> Tensor:
        """Return the features (B, T, F) of T steps, from `hidden` (B, M), which is zero where `start` (B, T) is 1."""
        if self.memory is None:
            return observation
        inputs = torch.cat([observation, previous_action], dim=-1)
        states = self.memory.through_episodes(inputs, hidden, start)
        return torch.cat([observation, self.memory.latent(states)], dim=-1)


class Policy(Remembering, ABC):
    """Acts on observations and its memory of them."""

    def remember(self, observation: Tensor, previous_action: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Process one step; return the features (B, F), and the next hidden (B, M)."""
        if self.memory is None:
            return observation, hidden
        hidden = self.memory.step(torch.cat([observation, previous_action], dim=-1), hidden)
        return torch.cat([observation, self.memory.latent(hidden)], dim=-1), hidden

    @abstractmethod
    def policy(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale (..., A) of a Gaussian for `features` (..., F)."""

    def log_prob(self, features: Tensor, action: Tensor) -> Tensor:
        """Return the log-density (...) of `action` (..., A) for `features` (..., F)."""
        return gaussian_log_prob(*self.policy(features), action)

    @abstractmethod
    def act(self, features: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the action (..., A), within ±1: the mode, or with `generator` a sample."""


def bounded(output: Tensor) -> Tensor:
    """Return `output` clipped to ±1, with its gradient: tanh is flat where policies push against walls."""
    return output + (output.clamp(-1.0, 1.0) - output).detach()


class ActorCritic(Policy):
    """Bounded Gaussian mean with a state-independent deviation, and a value."""

    def __init__(self, shape: PolicyShape) -> None:
        super().__init__(shape)
        self.actor = mlp((shape.feature_size, *shape.hidden_sizes, shape.action_size), inplace=True)
        self.critic = mlp((shape.feature_size, *shape.hidden_sizes, 1), inplace=True)
        self.log_std = nn.Parameter(torch.full((shape.action_size,), _INITIAL_LOG_STD))
        for network, gain in ((self.actor, 0.01), (self.critic, 1.0)):
            layers = [layer for layer in network if isinstance(layer, nn.Linear)]
            for layer in layers:
                nn.init.orthogonal_(layer.weight, 2**0.5)
                nn.init.zeros_(layer.bias)
            nn.init.orthogonal_(layers[-1].weight, gain)

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


_SMALLEST_SQUASHED = 1e-6 - 1.0  # actions beyond it are taken for it, since the tanh of no number is -1
_SMALLEST_SCALE = 1e-3
_UNIT_SCALE = math.log(math.e - 1.0)  # its softplus is 1


class SoftActor(Policy):
    """A Gaussian whose location and scale both depend on the features; actions are the tanh of samples."""

    def __init__(self, shape: PolicyShape) -> None:
        super().__init__(shape)
        self.actor = mlp((shape.feature_size, *shape.hidden_sizes, 2 * shape.action_size), nn.ReLU)

    def policy(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale (..., A) of the Gaussian, before the tanh, for `features` (..., F)."""
        loc, width = self.actor(features).chunk(2, dim=-1)
        return loc, functional.softplus(width + _UNIT_SCALE) + _SMALLEST_SCALE

    def log_prob(self, features: Tensor, action: Tensor) -> Tensor:
        """Return the log-density (...) of `action` (..., A), the tanh of what was drawn, for `features` (..., F)."""
        inside = action.clamp(_SMALLEST_SQUASHED, -_SMALLEST_SQUASHED)
        return super().log_prob(features, inside.atanh()) - torch.log1p(-inside.square()).sum(-1)

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


@dataclass(frozen=True)
class AdaptiveShape(PolicyShape):
    """Sizes of teacher and student."""

    extrinsics_size: int = 8  # E
    history_length: int = 50  # H, steps that the student's estimate is made from

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

    def remember_sequence(self, observation: Tensor, previous_action: Tensor, hidden: Tensor, start: Tensor) -> Tensor:
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
        moments = self.convolutions(torch.zeros(1, 32, length)).shape[-1]
        self.head = nn.Linear(32 * moments, extrinsics_size)

    def forward(self, history: Tensor) -> Tensor:
        """Return extrinsics (B, E), in [-1, 1], for `history` (B, H * I), the newest row last."""
        embedded = functional.elu(self.embedding(history.unflatten(-1, (self.length, -1))))
        seen = functional.elu(self.convolutions(embedded.transpose(1, 2)))
        return torch.tanh(self.head(seen.flatten(1)))


class Student(ActorCritic):
    """Actor and critic with extrinsics estimated from H observations and actions; hidden: memory, then history."""

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
        return torch.cat([features, self.adaptation(history)], dim=-1), torch.cat([memory, history], dim=-1)


class Critics(nn.Module):
    """V, two Q, and slow copies of these, of observations (..., O) and actions (..., A)."""

    def __init__(self, observation_size: int, action_size: int, hidden_sizes: tuple[int, ...]) -> None:
        super().__init__()
        self.value = mlp((observation_size, *hidden_sizes, 1), nn.ReLU, inplace=True)
        sizes = (observation_size + action_size, *hidden_sizes, 1)
        self.action_values = nn.ModuleList(mlp(sizes, nn.ReLU, inplace=True) for _ in range(2))
        self.slow_action_values = copy.deepcopy(self.action_values).requires_grad_(False)

    def advantage(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return min Q - V (...), by the slow Q, with the gradient of V alone."""
        pair = torch.cat([observation, action], dim=-1)
        first, second = (network(pair) for network in self.slow_action_values)
        return torch.as_tensor((torch.minimum(first, second) - self.value(observation)).squeeze(-1))


class RecurrentCritics(Remembering):
    """Two action values, and the memory that both share; layer normalization keeps them from diverging."""

    def __init__(self, shape: PolicyShape) -> None:
        super().__init__(shape)
        sizes = (shape.feature_size + shape.action_size, *shape.hidden_sizes, 1)
        self.networks = nn.ModuleList(mlp(sizes, nn.ReLU, inplace=True, norm=True) for _ in range(2))

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return both values (2, ...) of features (..., F) and actions (..., A)."""
        pair = torch.cat([features, action], dim=-1)
        return torch.stack([network(pair).squeeze(-1) for network in self.networks])


class ReturnScale(nn.Module):
    """The running deviation of discounted sums of B rows' rewards, as in VecNormalize of OpenAI Baselines."""

    def __init__(self, num_envs: int, discount: float) -> None:
        super().__init__()
        self.discount = discount
        self.sums: Tensor = nn.Buffer(torch.zeros(num_envs))
        count, mean, var = torch.tensor([1e-4, 0.0, 1.0], dtype=torch.float64)
        self.count: Tensor = nn.Buffer(count)
        self.mean: Tensor = nn.Buffer(mean)
        self.var: Tensor = nn.Buffer(var)

    def scaled(self, reward: Tensor, done: Tensor) -> Tensor:
        """Take in the rewards (B,) of a step, after which rows may be `done` (B,), and return them scaled."""
        self.sums = self.sums * self.discount + reward
        sums, count = self.sums.double(), len(reward)
        apart, total = sums.mean() - self.mean, self.count + count
        spread = self.var * self.count + sums.var(correction=0) * count
        self.var = (spread + apart.square() * self.count * count / total) / total
        self.mean, self.count = self.mean + apart * count / total, total
        self.sums = torch.where(done, 0.0, self.sums)
        deviation = (self.var + 1e-8).sqrt().float()
        return torch.clamp(reward / deviation, -_LARGEST_REWARD, _LARGEST_REWARD)


class UserPolicy(Policy):
    """A policy of another learner, in the place of one that was trained here; it has no memory."""

    def __init__(self, acting: ActingPolicy, observation_size: int, action_size: int) -> None:
        super().__init__(PolicyShape(observation_size, action_size))
        if not callable(getattr(acting, "act", None)):
            raise BadInputError(f"{type(acting).__name__} is no policy: expected act(observation) -> action")
        self.acting = acting

    @property
    def name(self) -> str:
        """The name of its class."""
        return type(self.acting).__name__

    def policy(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actions (B, A) for observations (B, O), and a scale of 0."""
        action = self.act(features)
        return action, torch.zeros_like(action)

    def act(self, features: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the actions (B, A), clipped to ±1, for observations (B, O); `generator` has no effect."""
        with explained(f"{self.name}.act"):
            action = np.asarray(self.acting.act(features.numpy()), dtype=np.float32)
        expected = (len(features), self.shape.action_size)
        if action.shape != expected:
            raise BadInputError(f"{self.name}.act: expected actions of shape {expected}, got {action.shape}")
        if not np.isfinite(action).all():
            raise BadInputError(f"{self.name}.act: expected finite actions, got NaN or infinity")
        return torch.from_numpy(action).clamp(-1.0, 1.0)


_MADE = ((ActorCritic, PolicyShape), (Student, AdaptiveShape), (SoftActor, PolicyShape))
NETWORKS: dict[str, tuple[type[Policy], type[PolicyShape]]] = dict(zip(PACKAGE_KINDS, _MADE, strict=True))
"""The policies of the package, with their shapes, by what their files call them."""
