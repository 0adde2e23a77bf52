"""Soft actor-critic on a batched environment (Haarnoja et al. 2018), with TorchRL's loss.

Where the policy has a memory, the critics share another one, and all learn from windows of recent steps,
whose first steps only fill the memories; otherwise they learn from single steps. At the start of a
window the policy's memory is the one stored while acting, since there it spans whole episodes (Kapturowski et
al. 2019); that of the critics, which see only windows, is empty.
"""

import copy
from itertools import pairwise
from typing import TYPE_CHECKING, Self

import torch
from pydantic import model_validator
from torch import Tensor, nn
from torch.nn import functional

from astra_data.core.config import Config, Count, NotNegative, Number, Positive, Share
from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.learning.acting import Acting
from astra_data.learning.learner import Learner
from astra_data.learning.networks.policy import features_of
from astra_data.learning.networks.soft_actor import SoftActor, gaussian
from astra_data.learning.recorded import Recorded
from astra_data.learning.replay import Replay
from astra_data.worlds.batched import BatchedEnv

if TYPE_CHECKING:
    from torchrl.objectives import SACLoss


class SacConfig(Config):
    """Settings of soft actor-critic."""

    total_steps: Count = 1_000_000
    """Environment steps in all."""
    rollout_steps: Count = 64
    """Batched steps per iteration."""
    updates_per_step: Count = 8
    """Gradient updates per batched step."""
    batch_size: Count = 256
    """Steps per update; where the policy has a memory, in as many windows as they make."""
    window: Count = 32
    """Consecutive steps per window, where the policy has a memory."""
    burn_in: Number = 8
    """Steps at the start of a window that only warm up the memory, until an episode starts."""
    buffer_size: Count = 1_000_000
    """Steps kept for replay, the most recent ones."""
    learning_rate: Positive = 1e-3
    """Learning rate of actor, critics and temperature; falls to zero over the second half of the training.
    Without that, the quality of the final policy is left to chance."""
    discount: Share = 0.97
    """Discount factor per step."""
    reward_scale: Positive = 1.0
    """Factor on the reward that the critics learn from."""
    initial_temperature: Positive = 0.2
    """Weight of the entropy in the reward, at the start."""
    target_rate: Share = 0.005
    """Polyak rate of the target critics, per update."""
    imitation_weight: NotNegative = 0.0
    """Weight of the mean squared distance from recorded actions in the actor's loss, relative to the size of
    the mean action value, entropy included. 0.4 is that of Fujimoto and Gu (2021), who take the mean of
    sizes. Without effect in the target: upper bounds use no recorded data."""

    @model_validator(mode="after")
    def _leaves_steps_to_learn_from(self) -> Self:
        if self.burn_in >= self.window:
            raise ValueError(f"burn_in: expected less than the window of {self.window}, got {self.burn_in}")
        if self.window > self.batch_size:
            raise ValueError(f"batch_size: expected a window of {self.window} or more, got {self.batch_size}")
        return self


class Sac(Learner):
    """A training in progress.

    Attributes:
        policy: the actor.
    """

    def __init__(
        self,
        env: BatchedEnv,
        policy: SoftActor,
        config: SacConfig,
        *,
        horizon: int,
        seed: int,
        recorded: Recorded | None = None,
    ) -> None:
        """Prepare to train `policy` in `env`.

        Args:
            env: the environment.
            policy: the actor.
            config: settings.
            horizon: steps after which episodes are truncated.
            seed: of all randomness.
            recorded: episodes to imitate, if any.

        Raises:
            BadInputError: the buffer is smaller than a window.
        """
        from torchrl.objectives import SoftUpdate

        self.policy, self.config = policy, config
        torch.manual_seed(derive(seed, "critics"))
        device = next(policy.parameters()).device
        self._loss = _sac_loss(policy, config).to(device)
        self._memory = policy.shape.new_memory()
        self._late_memory = copy.deepcopy(self._memory)
        memories = nn.ModuleList(filter(None, (self._memory, self._late_memory))).to(device)
        self._target = SoftUpdate(self._loss, tau=config.target_rate)
        learned = [*policy.parameters(), *self._loss.qvalue_network_params.parameters(), self._loss.log_alpha]
        learned += [] if self._memory is None else self._memory.parameters()
        self._optimizer = torch.optim.Adam(learned, lr=config.learning_rate, fused=True)
        self._window, self._burn_in = (config.window, config.burn_in) if policy.memory else (1, 0)
        if config.buffer_size // env.num_envs <= self._window:
            raise BadInputError(
                f"buffer_size: expected at least {(self._window + 1) * env.num_envs} steps, for a window of "
                f"{self._window} in {env.num_envs} environments, got {config.buffer_size}"
            )
        self._recorded = recorded
        self._replay = Replay(config.buffer_size, env, policy.shape.memory_size, device)
        torch.manual_seed(derive(seed, "first reset"))
        super().__init__(
            Acting(env, policy.initial_hidden(env.num_envs), horizon=horizon, is_staggered=False),
            {
                "policy": policy,
                "critics": self._loss,
                "memories": memories,
                "optimizer": self._optimizer,
                "replay": self._replay,
            },
            total_steps=config.total_steps,
            rollout_steps=config.rollout_steps,
            seed=seed,
        )

    def _iterate(self) -> dict[str, float]:
        """Take `rollout_steps` batched steps, learning after each; return the entropy's "temperature"."""
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.learning_rate * min(1.0, 2.0 * self.share_left)
        for _ in range(self.rollout_steps):
            self._act()
            if len(self._replay) > self._window:
                for _ in range(self.config.updates_per_step):
                    self._learn()
        return {"temperature": float(self._loss.log_alpha.detach().exp())}

    @torch.no_grad()
    def _act(self) -> None:
        """Take one step and add it to the buffer."""
        acting = self.acting
        seen = {
            "observation": acting.observation,
            "previous_action": acting.previous_action,
            "hidden": acting.hidden,
            "first": acting.first,
        }
        features, hidden = self.policy.remember(acting.observation, acting.previous_action, acting.hidden)
        loc, scale = self.policy.policy(features)
        taken = acting.take(torch.tanh(torch.normal(loc, scale)), hidden)
        self._replay.add(
            **seen,
            action=taken.action,
            reward=taken.step.reward * self.config.reward_scale,
            terminated=taken.step.terminated,
            expired=taken.expired,
        )

    def _learn(self) -> None:
        """Update actor, critics and temperature once."""
        from tensordict import TensorDict

        config = self.config
        steps, learned = self._replay.windows(config.batch_size // self._window, self._window, self._burn_in)
        if not bool(learned.any()):
            return
        seen, first = (steps["observation"], steps["previous_action"]), steps["first"].float()
        nothing = self.policy.initial_hidden(len(learned))
        acting = self.policy.remember_sequence(*seen, steps["hidden"][:, 0], first)
        judging = features_of(self._memory, *seen, nothing, first)
        with torch.no_grad():
            following = features_of(self._late_memory, *seen, nothing, first)[:, 1:][learned]
        terminated = steps["terminated"][:, :-1][learned].unsqueeze(-1)
        table = {
            "acting": acting[:, :-1][learned],
            "judging": judging[:, :-1][learned],
            "action": steps["action"][:, :-1][learned],
            "next": {
                "acting": acting[:, 1:][learned].detach(),
                "judging": following,
                "reward": steps["reward"][:, :-1][learned].unsqueeze(-1),
                "terminated": terminated,
                "done": terminated,
            },
        }
        batch = TensorDict(table, batch_size=[int(learned.sum())])
        wrong, _ = self._loss.qvalue_v2_loss(batch)
        # Detached: the actor must not change the critics' memory to raise its own values.
        costs, metadata = self._loss.actor_loss(batch.set("judging", batch["judging"].detach()))
        total = wrong + costs + self._loss.alpha_loss(metadata["log_prob"]).mean()
        if self._recorded is not None:
            size = costs.detach().abs()  # almost entirely action values
            total = total + config.imitation_weight * size * self._distance(self._recorded)
        self._optimizer.zero_grad()
        total.backward()
        self._optimizer.step()
        self._target.step()
        if self._memory is not None and self._late_memory is not None:
            for late, now in zip(self._late_memory.parameters(), self._memory.parameters(), strict=True):
                late.data.lerp_(now.data, config.target_rate)

    def _distance(self, recorded: Recorded) -> Tensor:
        """Return the mean squared distance of the policy's actions from the recorded ones."""
        steps, learned = recorded.windows(self.config.batch_size // self._window, self._window, self._burn_in)
        features = self.policy.remember_sequence(
            steps["observation"],
            steps["previous_action"],
            self.policy.initial_hidden(len(learned)),
            torch.zeros_like(learned, dtype=torch.float32),
        )
        return functional.mse_loss(self.policy.act(features[learned]), steps["action"][learned])


def _sac_loss(policy: SoftActor, config: SacConfig) -> "SACLoss":
    from tensordict.nn import TensorDictModule
    from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import SACLoss

    actor = ProbabilisticActor(
        TensorDictModule(_Policy(policy), in_keys=["acting"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    loss = SACLoss(
        actor,
        ValueOperator(_Critic(policy), in_keys=["judging", "action"]),
        num_qvalue_nets=2,
        loss_function="l2",
        target_entropy=-float(policy.shape.action_size),
        alpha_init=config.initial_temperature,
        deactivate_vmap=True,  # a sixth of the time, on a CPU
    )
    loss.make_value_estimator(gamma=config.discount)
    return loss


class _Policy(nn.Module):
    def __init__(self, policy: SoftActor) -> None:
        super().__init__()
        self.actor = policy.actor

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        return gaussian(self.actor(features))


class _Critic(nn.Module):
    """Action values; layer normalisation keeps them from diverging at this learning rate."""

    def __init__(self, policy: SoftActor) -> None:
        super().__init__()
        shape = policy.shape
        sizes = (shape.feature_size + shape.action_size, *shape.hidden_sizes)
        layers: list[nn.Module] = []
        for size_in, size_out in pairwise(sizes):
            layers += [nn.Linear(size_in, size_out), nn.LayerNorm(size_out), nn.ReLU()]
        self.network = nn.Sequential(*layers, nn.Linear(sizes[-1], 1))

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        return torch.as_tensor(self.network(torch.cat([features, action], dim=-1)))
