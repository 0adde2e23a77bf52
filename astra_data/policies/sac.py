"""Soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905) on a batched environment.

Policies with a memory learn from windows that begin with the memory stored while acting (Kapturowski et al. 2019); the
critics share another memory, which is empty there.
"""

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING, Self

from pydantic import model_validator

from astra_data.core.config import Config, Count, CountFromZero, Positive, Share
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.core.seeding import derive
from astra_data.grounding.descent import refuse_divergence
from astra_data.policies.learner import Learner
from astra_data.worlds.protocols import BatchedEnv

if TYPE_CHECKING:
    from astra_data.policies.networks import SoftActor
    from astra_data.policies.simulator_env import Recorded

_REWARD_SCALE = 0.1  # factor on the reward that the critics learn from
_INITIAL_TEMPERATURE = 0.2  # weight of the entropy in the reward at the start
_TARGET_RATE = 0.005  # polyak rate of the target critics, per update
_IMITATION_WEIGHT = 0.4  # of the distance from recorded actions, in mean action values; of Fujimoto and Gu (2021)


class SacConfig(Config):
    """Settings of soft actor-critic."""

    total_steps: Count = 1_000_000
    """Total number of environment steps."""
    rollout_steps: Count = 64
    """Batched steps per iteration."""
    updates_per_step: Count = 8
    """Gradient updates per batched step."""
    batch_size: Count = 256
    """Steps per update; if the policy has a memory, split into windows."""
    window: Count = 16
    """Consecutive steps per window, if the policy has a memory."""
    burn_in: CountFromZero = 4
    """Steps at the start of a window that only warm up the memory, until an episode starts."""
    buffer_size: Count = 160_000
    """Number of most recent steps kept for replay."""
    learning_rate: Positive = 3e-4
    """Learning rate of actor, critics and temperature; decays to zero over the second half of the training.
    Otherwise the quality of the final policy is left to chance."""
    discount: Share = 0.99
    """Discount factor per step."""

    @model_validator(mode="after")
    def _leaves_steps_to_learn_from(self) -> Self:
        if self.burn_in >= self.window:
            raise ValueError(f"burn_in: expected less than the window of {self.window}, got {self.burn_in}")
        if self.window > self.batch_size:
            raise ValueError(f"batch_size: expected a window of {self.window} or more, got {self.batch_size}")
        return self


class Sac(Learner):
    """A training in progress, of the actor `policy`."""

    def __init__(
        self,
        env: BatchedEnv,
        policy: "SoftActor",
        config: SacConfig,
        *,
        horizon: int,
        seed: int,
        recorded: "Recorded | None" = None,
    ) -> None:
        """Train in `env`, with episodes of at most `horizon` steps; the policy imitates what was `recorded`, if given.

        The actor's loss then has a term of behavior cloning (Fujimoto and Gu 2021, arXiv 2106.06860, eq. 3).
        """
        from astra_data.policies.networks import RecurrentCritics

        self.policy, self.config, self._recorded = policy, config, recorded
        torch.manual_seed(derive(seed, "critics"))
        device = next(policy.parameters()).device
        self._critics = RecurrentCritics(policy.shape).to(device)
        self._late_critics = copy.deepcopy(self._critics).requires_grad_(False)
        self._log_temperature = torch.nn.Parameter(torch.tensor(_INITIAL_TEMPERATURE, device=device).log())
        learned = [*policy.parameters(), *self._critics.parameters(), self._log_temperature]
        self._optimizer = torch.optim.Adam(learned, lr=config.learning_rate, fused=True)
        self._window, self._burn_in = (config.window, config.burn_in) if policy.memory else (1, 0)
        if config.buffer_size // env.num_envs <= self._window:
            raise BadInputError(
                f"buffer_size: expected at least {(self._window + 1) * env.num_envs} steps, for a window of "
                f"{self._window} in {env.num_envs} environments, got {config.buffer_size}"
            )
        self._replay = Replay(config.buffer_size, env, policy.shape.memory_size, device)
        torch.manual_seed(derive(seed, "first reset"))
        super().__init__(
            env,
            policy.initial_hidden(env.num_envs),
            {
                "policy": policy,
                "critics": self._critics,
                "late_critics": self._late_critics,
                "temperature": torch.nn.ParameterDict({"log": self._log_temperature}),
                "optimizer": self._optimizer,
                "replay": self._replay,
            },
            horizon=horizon,
            total_steps=config.total_steps,
            rollout_steps=config.rollout_steps,
            seed=seed,
            is_staggered=False,
        )

    def _iterate(self) -> dict[str, float]:
        """Take `rollout_steps` batched steps, learning after each; return the entropy's "temperature"."""
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.learning_rate * min(1.0, 2.0 * (1.0 - self.share))
        for _ in range(self.rollout_steps):
            self._act()
            if len(self._replay) > self._window:
                for _ in range(self.config.updates_per_step):
                    self._learn()
        return {"temperature": float(self._log_temperature.detach().exp())}

    def _cut(self) -> None:
        self._replay.cut()

    @without_gradients
    def _act(self) -> None:
        seen = {name: getattr(self, name) for name in ("observation", "previous_action", "hidden", "first")}
        features, hidden = self.policy.remember(self.observation, self.previous_action, self.hidden)
        loc, scale = self.policy.policy(features)
        step, action, expired, _ = self.take(torch.tanh(torch.normal(loc, scale)), hidden)
        reward = step.reward * _REWARD_SCALE
        self._replay.add(**seen, action=action, reward=reward, terminated=step.terminated, expired=expired)

    def _learn(self) -> None:
        config = self.config
        steps, learned = self._replay.windows(config.batch_size // self._window, self._window, self._burn_in)
        if not bool(learned.any()):
            return
        total = sum(self._losses(steps, learned), torch.zeros((), device=learned.device))
        refuse_divergence(f"after step {self.steps}", {"loss": float(total.detach())})
        self._optimizer.zero_grad()
        total.backward()
        self._optimizer.step()
        with torch.no_grad():
            late, now = self._late_critics.parameters(), self._critics.parameters()
            torch._foreach_lerp_([*late], [*now], _TARGET_RATE)

    def _losses(self, steps: dict[str, Tensor], learned: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the losses of critics, eq. 5, actor, eq. 7, and temperature, eq. 18: means over `learned` (B, T)."""
        critics, temperature = self._critics, self._log_temperature.detach().exp()
        seen, first = (steps["observation"], steps["previous_action"]), steps["first"].float()
        acting = self.policy.remember_sequence(*seen, steps["hidden"][:, 0], first)
        anew = *seen, critics.initial_hidden(len(first)), first
        judging = critics.remember_sequence(*anew)[:, :-1][learned]
        reward, terminated, taken = (steps[name][:, :-1][learned] for name in ("reward", "terminated", "action"))
        with torch.no_grad():
            action, log_prob = self.policy.sample(acting[:, 1:][learned])
            late = self._late_critics.remember_sequence(*anew)[:, 1:][learned]
            following = self._late_critics(late, action).amin(0) - temperature * log_prob
            wanted = reward + self.config.discount * ~terminated * following
        critic_loss = (critics(judging, taken) - wanted).square().mean(1).sum()
        action, log_prob = self.policy.sample(acting[:, :-1][learned])
        critics.requires_grad_(False)  # the actor must change neither critics nor their memory to raise its own values
        actor_loss = (temperature * log_prob - critics(judging.detach(), action).amin(0)).mean()
        critics.requires_grad_(True)
        if self._recorded is not None:
            size = actor_loss.detach().abs()  # for the most part action values
            actor_loss = actor_loss + _IMITATION_WEIGHT * size * self._distance(self._recorded)
        surplus = action.shape[-1] - log_prob.detach().mean()
        return critic_loss, actor_loss, self._log_temperature * surplus

    def _distance(self, recorded: "Recorded") -> Tensor:
        """Return the mean squared distance of the policy's actions, without exploration, from recorded ones."""
        places, learned = recorded.draw(self.config.batch_size // self._window, self._window, self._burn_in)
        features = recorded.features(self.policy, places)
        return (self.policy.act(features[learned]) - recorded.action[places][learned]).square().mean()


class Replay:
    """A ring buffer of the last steps of B environments, in contiguous tensors."""

    def __init__(self, size: int, env: BatchedEnv, memory_size: int, device: "torch.device") -> None:
        """Hold the last `size` steps of `env`, the same number per row, with memories of `memory_size`."""
        self._rows = size // env.num_envs
        self._added = 0
        place = self._rows, env.num_envs
        numbers = {"observation": (env.observation_size,), "action": (env.action_size,), "reward": ()}
        numbers |= {"previous_action": numbers["action"], "hidden": (memory_size,)}
        self._columns = {name: torch.empty(*place, *size, device=device) for name, size in numbers.items()}
        for name in ("terminated", "expired", "first"):
            self._columns[name] = torch.empty(place, dtype=torch.bool, device=device)

    def __len__(self) -> int:
        return min(self._added, self._rows)

    def add(self, **step: Tensor) -> None:
        """Add a step of every environment: the columns of `__init__`, (B, ...) each."""
        row = self._added % self._rows
        for name, column in self._columns.items():
            column[row] = step[name]
        self._added += 1

    def cut(self) -> None:
        """End all episodes with the last step, as where time runs out: the next one does not follow it."""
        if self._added:
            last = (self._added - 1) % self._rows
            self._columns["expired"][last] |= ~self._columns["terminated"][last]

    def windows(self, count: int, length: int, burn_in: int) -> tuple[dict[str, Tensor], Tensor]:
        """Draw windows (count, length + 1, ...), and which to learn from, (count, length): no `burn_in`, no horizon."""
        device = self._columns["reward"].device
        oldest = self._added - len(self)
        begin = oldest + torch.randint(len(self) - length, (count, 1), device=device)
        steps = (begin + torch.arange(length + 1, device=device)) % self._rows
        env = torch.randint(self._columns["reward"].shape[1], (count, 1), device=device)
        drawn = {name: column[steps, env] for name, column in self._columns.items()}
        filled = torch.arange(length, device=device) >= burn_in
        has_begun = drawn["first"][:, :-1].cumsum(1) > 0
        return drawn, ~drawn["expired"][:, :-1] & (filled | has_begun)

    def state_dict(self) -> dict[str, Tensor | int]:
        """Return the kept steps, apart from the room for others."""
        return {"added": self._added} | {name: column[: len(self)].clone() for name, column in self._columns.items()}

    def load_state_dict(self, state: Mapping[str, Tensor | int]) -> None:
        """Continue with the steps in `state`."""
        self._added = int(state["added"])
        for name, column in self._columns.items():
            column[: len(self)] = torch.as_tensor(state[name], device=column.device)
