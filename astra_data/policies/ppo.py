"""Proximal policy optimization (Schulman et al. 2017) on a batched environment."""

import math
from typing import TYPE_CHECKING

from astra_data.core.arrays import gaussian_log_prob
from astra_data.core.config import Config, Count, Positive, Share
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.core.seeding import derive
from astra_data.grounding.descent import refuse_divergence
from astra_data.policies.learner import Learner
from astra_data.worlds.protocols import BatchedEnv

if TYPE_CHECKING:
    from astra_data.policies.networks import ActorCritic

EPOCHS, MINIBATCHES = 5, 16  # passes over a rollout, and updates per pass
_SEGMENT_STEPS = 16  # at most, of a segment: it begins with the memory that the policy had there when it acted
GAE_LAMBDA, CLIP, VALUE_WEIGHT, GRADIENT_NORM = 0.95, 0.2, 0.5, 0.5
_CRITIC_GAIN = 0.01
"""Initial gain of the critic's last layer. With 1, its values exceed small returns, so the first advantages
reflect the untrained critic instead of the rewards."""
_MAX_KL = 0.03
"""An iteration's passes stop once a minibatch's policy has diverged this far from the one that collected the
rollout: as action noise fades, ever smaller updates undo learning."""
_FINAL_STD, _FADE_SHARE = 0.15, 0.5
"""The limit of the actions' standard deviation falls to this, by equal factors, over this share of the
training, so that the policy is trained as it is tested."""
_PULL = 0.05  # weight in the loss of the square by which clipped means are beyond ±1

_SEEN = ("observation", "previous_action", "hidden", "start")
_LEARNED = ("action", "action_log_prob", "advantage", "value_target")


class PpoConfig(Config):
    """Settings of proximal policy optimization."""

    total_steps: Count = 2_000_000
    """Maximum number of environment steps; a training whose episodes succeed ends earlier."""
    rollout_steps: Count = 64
    """Steps of each environment per iteration. A memory learns through as many as divide these, at most 16."""
    learning_rate: Positive = 5e-4
    """Learning rate at the start; decays linearly to zero."""
    discount: Share = 0.99
    """Discount factor per step."""


class Ppo(Learner):
    """A training in progress."""

    def __init__(self, env: BatchedEnv, policy: "ActorCritic", config: PpoConfig, *, horizon: int, seed: int) -> None:
        if env.num_envs * config.rollout_steps == 1:
            raise BadInputError("rollout_steps: expected 2 or more in a single environment, got 1")
        from astra_data.policies.networks import ReturnScale

        self.policy, self.config = policy, config
        with torch.no_grad():
            list(policy.critic.parameters())[-2].mul_(_CRITIC_GAIN)
        self._first_std = float(policy.log_std.detach().exp().max())
        self._optimizer = torch.optim.Adam(policy.parameters(), lr=config.learning_rate, eps=1e-5, fused=True)
        self._returns = ReturnScale(env.num_envs, config.discount).to(policy.log_std.device)
        self._segment_steps = max(n for n in range(1, _SEGMENT_STEPS + 1) if config.rollout_steps % n == 0)
        torch.manual_seed(derive(seed, "first reset"))
        super().__init__(
            env,
            policy.initial_hidden(env.num_envs),
            {"policy": policy, "optimizer": self._optimizer, "returns": self._returns},
            horizon=horizon,
            total_steps=config.total_steps,
            rollout_steps=config.rollout_steps,
            seed=seed,
        )

    def _iterate(self) -> dict[str, float]:
        """Collect one rollout and learn from it; return the mean "std" of the actions."""
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.learning_rate * (1.0 - self.share)
        self._learn(self._collect())
        faded = min(1.0, self.share / _FADE_SHARE)
        with torch.no_grad():
            self.policy.log_std.clamp_(max=math.log(self._first_std) + faded * math.log(_FINAL_STD / self._first_std))
        figures = {"std": float(self.policy.log_std.detach().exp().mean())}
        refuse_divergence(f"after step {self.steps}", figures)
        return figures

    @without_gradients
    def _collect(self) -> dict[str, Tensor]:
        policy, columns, memories = self.policy, dict[str, list[Tensor]](), list[Tensor]()
        for number in range(self.rollout_steps):
            if number % self._segment_steps == 0:
                memories.append(self.hidden)
            row = {
                "observation": self.observation,
                "previous_action": self.previous_action,
                "start": self.first.float(),
            }
            features, hidden = policy.remember(self.observation, self.previous_action, self.hidden)
            mean, std = policy.policy(features)
            action = torch.normal(mean, std)
            step, applied, expired, done = self.take(action, hidden)
            row |= {"features": features, "mean": mean, "std": std, "action": action}
            row |= {"reward": self._returns.scaled(step.reward, done), "terminated": step.terminated, "done": done}
            row["beyond"] = torch.zeros_like(step.reward)
            if bool(expired.any()):
                beyond, _ = policy.remember(step.observation[expired], applied[expired], hidden[expired])
                row["beyond"][expired] = policy.value(beyond)
            for name, values in row.items():
                columns.setdefault(name, []).append(values)
        rollout = {name: torch.stack(values, dim=1) for name, values in (columns | {"hidden": memories}).items()}
        rollout["value"] = policy.value(rollout["features"])
        rollout["action_log_prob"] = gaussian_log_prob(rollout["mean"], rollout["std"], rollout["action"])
        last, _ = policy.remember(self.observation, self.previous_action, self.hidden)
        following = torch.cat([rollout["value"][:, 1:], policy.value(last).unsqueeze(1)], dim=1)
        following = torch.where(rollout["done"], rollout["beyond"], following)
        parts = rollout["value"], following, rollout["reward"], rollout["done"], rollout["terminated"]
        advantage = generalized_advantages(*parts, discount=self.config.discount)
        return rollout | {"advantage": advantage, "value_target": advantage + rollout["value"]}

    def _learn(self, rollout: dict[str, Tensor]) -> None:
        advantage = rollout["advantage"]
        rollout["advantage"] = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        segments = {
            name: rollout[name].unflatten(1, (-1, self._segment_steps)).flatten(0, 1)
            for name in {*_SEEN, *_LEARNED} - {"hidden"}
        }
        segments["hidden"] = rollout["hidden"].flatten(0, 1)
        for _ in range(EPOCHS):
            order = torch.randperm(len(segments["action"]), device=advantage.device)
            for rows in order.chunk(MINIBATCHES):
                loss, moved = self._loss({name: values[rows] for name, values in segments.items()})
                if moved.abs() > _MAX_KL:
                    return
                self._optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.policy.parameters(), GRADIENT_NORM)
                self._optimizer.step()

    def _loss(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the loss (eq. 9 with eq. 7's objective), and an estimate of the KL from the policy that collected."""
        policy = self.policy
        remembered = policy.remember_sequence(*(batch[name] for name in _SEEN))
        features, action, action_log_prob, advantage, target = (
            values.flatten(0, 1) for values in (remembered, *(batch[name] for name in _LEARNED))
        )
        output = policy.actor(features)
        mean, std = policy.gaussian(output)
        moved = gaussian_log_prob(mean, std, action) - action_log_prob
        ratio = moved.exp()
        clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
        gain = torch.minimum(ratio * advantage, clipped * advantage).mean()
        critic_loss = (policy.value(features) - target).square().mean()
        beyond = (output.abs() - 1.0).clamp_min(0.0).square().mean()
        return VALUE_WEIGHT * critic_loss - gain + _PULL * beyond, -moved.mean()


def generalized_advantages(
    value: Tensor, following: Tensor, reward: Tensor, done: Tensor, terminated: Tensor, *, discount: float
) -> Tensor:
    """Return generalized advantages (B, T) (Schulman et al. 2016, eq. 16); `following` are values after the steps."""
    error = reward + discount * following * ~terminated - value
    kept = discount * GAE_LAMBDA * (~done).to(value.dtype)
    advantage, later = torch.empty_like(error), torch.zeros_like(error[:, 0])
    for step in reversed(range(error.shape[1])):
        later = advantage[:, step] = error[:, step] + kept[:, step] * later
    return advantage
