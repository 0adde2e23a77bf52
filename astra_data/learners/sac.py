"""Soft actor-critic on a batched environment (Haarnoja et al. 2018), with TorchRL's loss."""

from collections.abc import Callable
from itertools import pairwise

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from astra_data.batched import BatchedEnv
from astra_data.recipe import Config


class SacConfig(Config):
    """Settings of soft actor-critic."""

    env_steps: int = 1_000_000
    """Environment steps in all."""
    updates_per_step: int = 8
    """Gradient updates per batched step."""
    batch_size: int = 256
    """Transitions per update."""
    buffer_size: int = 1_000_000
    """The most recent transitions that are kept."""
    hidden_sizes: tuple[int, ...] = (128, 128)
    """Of actor and critics."""
    learning_rate: float = 1e-3
    """Of actor, critics and temperature."""
    discount: float = 0.97
    """Of the reward, per step."""
    target_rate: float = 0.005
    """Share by which the target critics follow, per update."""
    episode_steps: int = 1000
    """Rows are restarted after so many steps, without ending the task."""


def actor_network(observation_size: int, action_size: int, hidden_sizes: tuple[int, ...]) -> nn.Sequential:
    """Build the actor's network: observation (B, O) to location and scale parameters (B, 2A)."""
    sizes = (observation_size, *hidden_sizes)
    layers: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        layers += [nn.Linear(size_in, size_out), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], 2 * action_size))


class _Critic(nn.Module):
    """Action values; layer-normalised, which keeps them from diverging at this learning rate."""

    def __init__(self, observation_size: int, action_size: int, hidden_sizes: tuple[int, ...]) -> None:
        super().__init__()
        sizes = (observation_size + action_size, *hidden_sizes)
        layers: list[nn.Module] = []
        for size_in, size_out in pairwise(sizes):
            layers += [nn.Linear(size_in, size_out), nn.LayerNorm(size_out), nn.ReLU()]
        self.network = nn.Sequential(*layers, nn.Linear(sizes[-1], 1))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return torch.as_tensor(self.network(torch.cat([observation, action], dim=-1)))


def train_sac(
    env: BatchedEnv,
    config: SacConfig,
    *,
    seed: int,
    network: nn.Sequential | None = None,
    on_step: Callable[[int, nn.Sequential], None] = lambda steps, network: None,
) -> nn.Sequential:
    """Train a tanh-Gaussian policy and return its network.

    Args:
        env: the world to train in.
        config: settings.
        seed: of the networks, the noise and the batches.
        network: an actor to go on from; a new one by default.
        on_step: called after each batched step with the environment steps done and the actor's network.
    """
    torch.manual_seed(seed)
    network = network or actor_network(env.observation_size, env.action_size, config.hidden_sizes)
    parameters = NormalParamExtractor(scale_lb=1e-3)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(network, parameters),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=False,
    )
    critic = ValueOperator(
        _Critic(env.observation_size, env.action_size, config.hidden_sizes),
        in_keys=["observation", "action"],
    )
    loss = SACLoss(
        actor,
        critic,
        num_qvalue_nets=2,
        loss_function="l2",
        target_entropy=-float(env.action_size),
        alpha_init=0.2,
    )
    loss.make_value_estimator(gamma=config.discount)
    target = SoftUpdate(loss, tau=config.target_rate)
    optimizer = torch.optim.Adam(loss.parameters(), lr=config.learning_rate)
    buffer = _Buffer(config.buffer_size, env)
    observation = env.reset()
    age = torch.zeros(env.num_envs)
    steps = 0
    while steps < config.env_steps:
        with torch.no_grad():
            action = TanhNormal(*parameters(network(observation))).sample()
        step = env.step(action)
        buffer.add(observation, action, step.reward, step.observation, step.terminated)
        age += 1
        restart = step.terminated | (age >= config.episode_steps)
        age[restart] = 0
        observation = env.reset(restart) if bool(restart.any()) else step.observation
        steps += env.num_envs
        for _ in range(config.updates_per_step):
            losses = loss(buffer.sample(config.batch_size))
            total = losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]
            optimizer.zero_grad()
            total.backward()
            optimizer.step()
            target.step()
        on_step(steps, network)
    return network


class _Buffer:
    """The most recent transitions, in contiguous tensors."""

    def __init__(self, capacity: int, env: BatchedEnv) -> None:
        self._capacity = capacity - capacity % env.num_envs
        self._columns = {
            "observation": torch.empty(self._capacity, env.observation_size),
            "action": torch.empty(self._capacity, env.action_size),
            "reward": torch.empty(self._capacity, 1),
            "next_observation": torch.empty(self._capacity, env.observation_size),
            "terminated": torch.empty(self._capacity, 1, dtype=torch.bool),
        }
        self._added = 0

    def add(
        self, observation: Tensor, action: Tensor, reward: Tensor, following: Tensor, terminated: Tensor
    ) -> None:
        start = self._added % self._capacity
        rows = slice(start, start + len(observation))
        values = (observation, action, reward[:, None], following, terminated[:, None])
        for column, value in zip(self._columns.values(), values, strict=True):
            column[rows] = value
        self._added += len(observation)

    def sample(self, count: int) -> TensorDict:
        rows = torch.randint(min(self._added, self._capacity), (count,))
        batch = {name: column[rows] for name, column in self._columns.items()}
        following = {
            "observation": batch.pop("next_observation"),
            "reward": batch.pop("reward"),
            "terminated": batch["terminated"],
            "done": batch.pop("terminated"),
        }
        return TensorDict({**batch, "next": following}, batch_size=[count])
