"""Implicit Q-learning (Kostrikov et al. 2022) from recorded episodes, with TorchRL's losses.

As in their Algorithm 1 the critics come first, from single transitions, for they do not depend on the policy;
then the policy is extracted by advantage-weighted regression, from windows of consecutive steps, so that a
recurrent policy learns with its memory. The critics see no history: the recorded random commands are held for
a while, and critics that know the last command learn little about any other.

Every update seeds torch from (seed, update), so a run resumed from a checkpoint gives the same result as an
uninterrupted one.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import torch
from pydantic import model_validator
from torch import Tensor, nn

from astra_data.core.config import AtOnce, Config, Count, NotNegative, Number, Positive, Share
from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.learning.networks.history import mlp
from astra_data.learning.networks.policy import Policy
from astra_data.learning.recorded import Recorded

if TYPE_CHECKING:
    from tensordict import TensorDict
    from torchrl.objectives import IQLLoss


class IqlConfig(Config):
    """How a policy is learned from recorded episodes. The paper prints none of these."""

    critic_updates: Count = 5_000
    """Gradient updates of the critics, before the first of the policy."""
    critic_batch: AtOnce = 256
    """Transitions per update of the critics."""
    critic_sizes: tuple[AtOnce, ...] = (128, 128)
    """Hidden layers of each critic."""
    critic_learning_rate: Positive = 1e-3
    """Of the critics."""
    target_rate: Share = 0.005
    """Polyak rate of the target action values, per update."""
    expectile: Share = 0.9
    """Expectile of action values that the state value estimates; that of the method's authors for AntMaze."""
    discount: Share = 0.99
    """Discount factor per step."""
    return_steps: Count = 10
    """Length of n-step returns, which sum recorded rewards and the state value after them. 1 is the method as
    printed: at 20 steps/s a single command hardly moves the robot, and its advantage is lost in the critics'
    errors."""
    reward_scale: Positive = 1.0
    """Factor on the recorded reward, before the shift."""
    reward_shift: float = 0.0
    """Added to each step's reward; 0 by default, as progress is rewarded in every step. The -1 that is usual
    for sparse rewards rewards falling over where that ends the task."""
    policy_updates: Count = 600
    """Gradient updates of the policy."""
    batch_windows: AtOnce = 24
    """Windows per update of the policy."""
    window: AtOnce = 100
    """Steps per window, in backpropagation through time."""
    burn_in: Number = 20
    """Steps at the start of a window that only warm up the memory; none where the episode starts there."""
    learning_rate: Positive = 1e-3
    """Of the policy at the start; falls to zero along a half cosine."""
    temperature: NotNegative = 10.0
    """Inverse temperature of the advantage weights, which are clipped at 100; that of the method's
    authors for AntMaze."""
    gradient_norm: Positive = 1.0
    """The policy's gradients are clipped to this norm."""

    @model_validator(mode="after")
    def _leaves_steps_to_learn_from(self) -> Self:
        if self.burn_in >= self.window:
            raise ValueError(f"burn_in: expected less than the window of {self.window}, got {self.burn_in}")
        return self


FINE_TUNING = IqlConfig(learning_rate=1e-4, policy_updates=100)
"""For fine-tuning: small steps, since a trained policy otherwise unlearns more than it learns."""


@dataclass(frozen=True)
class Experience(Recorded):
    """Recorded episodes with rewards; observations are what the policy sees, then what only the critics see.

    Attributes:
        reward: (E, T). next_observation: as `observation`, (E, T, O).
        terminated: (E, T) bool, the task ended there: no bootstrapping. Not set by time-outs.
    """

    reward: Tensor
    next_observation: Tensor
    terminated: Tensor


class Iql:
    """A training in progress.

    Attributes:
        policy: the networks being trained. updates: gradient updates done, of critics and policy.
    """

    def __init__(self, policy: Policy, experience: Experience, config: IqlConfig, *, seed: int) -> None:
        """Prepare to train `policy` in place on `experience`, with all randomness from `seed`."""
        from torchrl.objectives import SoftUpdate

        self.policy, self.config, self.seed = policy, config, seed
        self.updates = 0
        self._experience = experience
        self._transitions = transitions(experience, config)
        torch.manual_seed(derive(seed, "critics"))
        self._loss = _iql_loss(policy, experience, config)
        self._target = SoftUpdate(self._loss, tau=config.target_rate)
        self._critics = [
            *self._loss.qvalue_network_params.parameters(),
            *self._loss.value_network_params.parameters(),
        ]
        self._actor = [*self._loss.actor_network_params.parameters()]
        self._critic_optimizer = torch.optim.Adam(self._critics, lr=config.critic_learning_rate)
        self._optimizer = torch.optim.Adam(self._actor, lr=config.learning_rate)

    @property
    def total_updates(self) -> int:
        """Gradient updates of critics and policy in all."""
        return self.config.critic_updates + self.config.policy_updates

    @property
    def done(self) -> bool:
        """Whether all updates are done."""
        return self.updates >= self.total_updates

    def iterate(self) -> dict[str, float]:
        """Make one update and return its losses: "value" and "action_value", or the "policy"'s."""
        torch.manual_seed(derive(self.seed, f"update {self.updates}"))
        losses = (
            self._learn_values()
            if self.updates < self.config.critic_updates
            else self._learn_policy(self.updates - self.config.critic_updates)
        )
        self.updates += 1
        return losses

    def _learn_values(self) -> dict[str, float]:
        rows = torch.randint(len(self._transitions), (self.config.critic_batch,))
        batch = self._transitions[rows.to(self._transitions.device)]
        value = self._loss.value_loss(batch)[0].mean()
        action_value = self._loss.qvalue_loss(batch)[0].mean()
        self._critic_optimizer.zero_grad()
        (value + action_value).backward()
        self._critic_optimizer.step()
        self._target.step()
        return {"value": float(value.detach()), "action_value": float(action_value.detach())}

    def _learn_policy(self, update: int) -> dict[str, float]:
        from tensordict import TensorDict

        config = self.config
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate * (1 + math.cos(math.pi * update / config.policy_updates)) / 2
        columns, learned = self._experience.windows(config.batch_windows, config.window, config.burn_in)
        loss = self._loss.actor_loss(TensorDict(columns, batch_size=learned.shape))[0][learned].mean()
        self._optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self._actor, config.gradient_norm)
        self._optimizer.step()
        return {"policy": float(loss.detach())}

    @torch.no_grad()
    def values(self, observation: Tensor) -> Tensor:
        """Return the state values (...) of `observation` (..., O)."""
        from tensordict import TensorDict

        batch = TensorDict({"observation": observation}, batch_size=observation.shape[:-1])
        with self._loss.value_network_params.to_module(self._loss.value_network):
            return torch.as_tensor(self._loss.value_network(batch)["state_value"].squeeze(-1))

    def state_dict(self) -> dict[str, Any]:
        """Return all that `load_state_dict` needs to continue from here."""
        return {
            "networks": self._loss.state_dict(),
            "critic_optimizer": self._critic_optimizer.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state`."""
        self._loss.load_state_dict(state["networks"])
        self._critic_optimizer.load_state_dict(state["critic_optimizer"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.updates = state["updates"]


def transitions(experience: Experience, config: IqlConfig) -> "TensorDict":
    """Return the transitions (N,) of `experience` with n-step returns and the observation n steps later.

    n is `config.return_steps`. Steps with fewer recorded steps after them are left out, unless the task ended
    there.

    Raises:
        BadInputError: there are none.
    """
    from tensordict import TensorDict

    count, lengths = config.return_steps, experience.lengths[:, None]
    step = torch.arange(experience.reward.shape[1], device=lengths.device).expand_as(experience.reward)
    reward = (experience.reward * config.reward_scale + config.reward_shift) * (step < lengths)
    weights = config.discount ** torch.arange(count, device=reward.device)
    summed = (nn.functional.pad(reward, (0, count - 1)).unfold(1, count, 1) * weights).sum(-1)
    last = (step + count - 1).minimum(lengths - 1)
    rows = (torch.arange(len(lengths), device=lengths.device)[:, None], last)
    terminated = experience.terminated[rows]
    table = {
        "observation": experience.observation,
        "action": experience.action,
        "next": {
            "observation": experience.next_observation[rows],
            "reward": summed.unsqueeze(-1),
            "terminated": terminated.unsqueeze(-1),
            "done": terminated.unsqueeze(-1),
        },
    }
    whole = (step + count <= lengths) | (terminated & (step < lengths))
    if not bool(whole.any()):
        raise BadInputError(
            f"expected an episode of at least {count} steps (return_steps), or one that ends the task; "
            f"the longest has {int(lengths.max())}"
        )
    return TensorDict(table, batch_size=reward.shape)[whole]


def _iql_loss(policy: Policy, experience: Experience, config: IqlConfig) -> "IQLLoss":
    from tensordict.nn import TensorDictModule
    from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import IQLLoss

    observed, acted = experience.observation.shape[-1], experience.action.shape[-1]
    actor = ProbabilisticActor(
        TensorDictModule(
            _Policy(policy), in_keys=["observation", "previous_action"], out_keys=["loc", "scale"]
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal if policy.squashes else IndependentNormal,
        distribution_kwargs={"tanh_loc": False},
    )
    loss = IQLLoss(
        actor,
        ValueOperator(_ActionValue(observed, acted, config), in_keys=["observation", "action"]),
        ValueOperator(mlp((observed, *config.critic_sizes, 1), nn.ReLU), in_keys=["observation"]),
        loss_function="l2",
        temperature=config.temperature,
        expectile=config.expectile,
        reduction="none",
        scalar_output_mode="exclude",
    )
    loss.make_value_estimator(gamma=config.discount**config.return_steps)
    return loss.to(experience.observation.device)


class _ActionValue(nn.Module):
    def __init__(self, observed: int, acted: int, config: IqlConfig) -> None:
        super().__init__()
        self.network = mlp((observed + acted, *config.critic_sizes, 1), nn.ReLU)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return torch.as_tensor(self.network(torch.cat([observation, action], dim=-1)))


class _Policy(nn.Module):
    """The policy over whole windows (B, T, ...), from an empty memory."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor, previous_action: Tensor) -> tuple[Tensor, Tensor]:
        start = torch.zeros(observation.shape[:2], device=observation.device)
        hidden = self.policy.initial_hidden(len(observation))
        seen = observation[..., : self.policy.shape.observation_size]
        features = self.policy.remember_sequence(seen, previous_action, hidden, start)
        mean, std = self.policy.policy(features)
        return mean, std
