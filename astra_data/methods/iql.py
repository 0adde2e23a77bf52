"""IQL on the target's own episodes, direct transfer fine-tuned by it (Section V), and behavior cloning.

The paper does not say whether the fine-tuning interacts with the target: ours learns from the same episodes.
"""

import copy
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from pydantic import model_validator

from astra_data.core.artifact import CHECKPOINT
from astra_data.core.checkpoint import Logbook
from astra_data.core.config import AtOnce, Config, Count, CountFromZero, NotNegative, Positive, Share, own_settings
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.core.seeding import derive
from astra_data.dataset.columns import REWARD
from astra_data.grounding.descent import refuse_divergence, seed_generators
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods.method import Method, Table
from astra_data.policies.running_policy import PolicyFile
from astra_data.policies.simulator_env import Recorded, policy_observation, without_padding
from astra_data.policies.train import Training
from astra_data.worlds.task import Task

if TYPE_CHECKING:
    from astra_data.grounding.encoder import PositionFeatures
    from astra_data.policies.networks import Policy

_LARGEST_WEIGHT = 100.0
_CRITIC_BATCH = 256  # transitions per update of the critics
_CRITIC_SIZES = (128, 128)
_CRITIC_LEARNING_RATE = 1e-3
_TARGET_RATE = 0.005  # polyak rate of the target action values, per update
_GRADIENT_NORM = 1.0  # the policy's gradients are clipped to this norm
_ROWS_AT_ONCE = 8192


class IqlConfig(Config):
    """How a policy is learned from recorded episodes. The paper gives none of these settings."""

    critic_updates: Count = 5_000
    """Gradient updates of the critics, all before the policy's first update."""
    expectile: Share = 0.9
    """Expectile of the action values that the state value estimates; the authors' value for AntMaze."""
    discount: Share = 0.99
    """Discount factor per step."""
    return_steps: Count = 10
    """Length of n-step returns, which sum recorded rewards and add the state value after them. 1 is the published
    method: at 20 steps/s a single command hardly moves the robot, and its advantage drowns in the critics' errors."""
    reward_scale: Positive = 1.0
    """Factor on the recorded reward."""
    policy_updates: Count = 600
    """Gradient updates of a new policy."""
    fine_tuning_updates: Count = 100
    """Gradient updates of a trained policy, at a tenth of the learning rate: with more or larger ones it
    unlearns more than it learns."""
    batch_windows: AtOnce = 24
    """Windows per update of the policy."""
    window: AtOnce = 100
    """Steps per window, in backpropagation through time."""
    burn_in: CountFromZero = 20
    """Steps at the start of a window that only warm up the memory; none where an episode starts."""
    learning_rate: Positive = 1e-3
    """Learning rate of the policy at the start; decays to zero along a half cosine."""
    temperature: NotNegative = 10.0
    """Inverse temperature of the advantage weights, which are clipped at 100; the authors' value for AntMaze."""

    @model_validator(mode="after")
    def _leaves_steps_to_learn_from(self) -> Self:
        if self.burn_in >= self.window:
            raise ValueError(f"burn_in: expected less than the window of {self.window}, got {self.burn_in}")
        return self


@dataclass(frozen=True)
class Experience(Recorded):
    """Recorded episodes with their outcomes; observations are what the policy sees, then what critics do."""

    reward: Tensor  # (E, T)
    next_observation: Tensor  # (E, T, O)
    terminated: Tensor  # (E, T) bool, the task ended there: no bootstrapping; not set by time-outs


class Transitions(NamedTuple):
    """N transitions of n steps, from which the critics learn."""

    observation: Tensor  # (N, O)
    action: Tensor  # (N, A)
    reward: Tensor  # (N,), summed and discounted over the n steps
    next_observation: Tensor  # (N, O), n steps later
    terminated: Tensor  # (N,) bool, the task ended there


class Iql:
    """A training in progress, after so many `updates` of critics and policy."""

    def __init__(self, policy: "Policy", experience: Experience, config: IqlConfig, *, seed: int) -> None:
        from astra_data.policies.networks import Critics

        self.policy, self.config, self.seed = policy, config, seed
        self.updates = 0
        self._experience = experience
        self._transitions = transitions(experience, config)
        torch.manual_seed(derive(seed, "critics"))
        observed, acted = experience.observation.shape[-1], experience.action.shape[-1]
        self._critics = Critics(observed, acted, _CRITIC_SIZES).to(experience.observation.device)
        slow, fast = self._critics.slow_action_values, self._critics.action_values
        # Listed once, since finding a network's parameters takes as long as updating them.
        self._slow: list[Tensor] = [*slow.parameters()]
        self._fast: list[Tensor] = [*fast.parameters()]
        self._policy_parameters = [*policy.parameters()]
        learned = [*self._critics.value.parameters(), *fast.parameters()]
        self._critic_optimizer = torch.optim.Adam(learned, lr=_CRITIC_LEARNING_RATE, fused=True)
        self._optimizer = torch.optim.Adam(self._policy_parameters, lr=config.learning_rate, fused=True)
        self._parts: dict[str, Any] = {"critics": self._critics, "policy": policy}
        self._parts |= {"critic_optimizer": self._critic_optimizer, "optimizer": self._optimizer}
        self._weights: Tensor | None = None

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
        seed_generators(derive(self.seed, f"update {self.updates}"), self._transitions.reward.device)
        update = self.updates - self.config.critic_updates
        losses = self._learn_values() if update < 0 else self._learn_policy(update)
        self.updates += 1
        refuse_divergence(f"in update {self.updates}", losses)
        return losses

    def _learn_values(self) -> dict[str, float]:
        """Take a step down the losses of V, eq. 5, and Q, eq. 6; let the slow Q follow."""
        config, critics, table = self.config, self._critics, self._transitions
        rows = torch.randint(len(table.reward), (_CRITIC_BATCH,)).to(table.reward.device)
        observation, action = table.observation[rows], table.action[rows]
        advantage = critics.advantage(observation, action)
        weight = torch.where(advantage > 0, config.expectile, 1.0 - config.expectile)
        value = (weight * advantage.square()).mean()
        with torch.no_grad():
            following = critics.value(table.next_observation[rows]).squeeze(-1) * ~table.terminated[rows]
            wanted = table.reward[rows] + config.discount**config.return_steps * following
        pair = torch.cat([observation, action], dim=-1)
        first, second = (network(pair).squeeze(-1) - wanted for network in critics.action_values)
        action_value = first.square().mean() + second.square().mean()
        self._critic_optimizer.zero_grad()
        (value + action_value).backward()
        self._critic_optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(self._slow, self._fast, _TARGET_RATE)
        return {"value": float(value.detach()), "action_value": float(action_value.detach())}

    def _learn_policy(self, update: int) -> dict[str, float]:
        """Take a step down the loss of the policy, eq. 7."""
        config, policy = self.config, self.policy
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate * (1 + math.cos(math.pi * update / config.policy_updates)) / 2
        if self._weights is None:
            self._weights = self._weigh()
        steps, is_learned = self._experience.draw(config.batch_windows, config.window, config.burn_in)
        features = self._experience.features(policy, steps)
        learned = is_learned.nonzero(as_tuple=True)
        likelihood = policy.log_prob(features[learned], self._experience.action[steps][learned])
        loss = -(self._weights[steps][learned] * likelihood).mean()
        self._optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._policy_parameters, _GRADIENT_NORM)
        self._optimizer.step()
        return {"policy": float(loss.detach())}

    @without_gradients
    def _weigh(self) -> Tensor:
        """Return the weight exp(β (Q - V)) of each recorded step, (E, T), by the finished critics."""
        columns = self._experience.observation, self._experience.action
        rows = zip(*(column.flatten(0, 1).split(_ROWS_AT_ONCE) for column in columns), strict=True)
        advantage = torch.cat([self._critics.advantage(*row) for row in rows])
        weights = (self.config.temperature * advantage).exp().clamp_max(_LARGEST_WEIGHT)
        return weights.view(self._experience.reward.shape)

    def state_dict(self) -> dict[str, Any]:
        """Return all that `load_state_dict` needs to continue from here."""
        return {name: part.state_dict() for name, part in self._parts.items()} | {"updates": self.updates}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state`."""
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        self.updates, self._weights = state["updates"], None


def transitions(experience: Experience, config: IqlConfig) -> Transitions:
    """Return the transitions (N,) of `experience` with returns of `config.return_steps` and the observation then."""
    lengths = experience.lengths[:, None]
    count = min(config.return_steps, int(lengths.max()) + 1)  # no episode has more
    step = torch.arange(experience.reward.shape[1], device=lengths.device).expand_as(experience.reward)
    reward = (experience.reward * config.reward_scale) * (step < lengths)
    weights = config.discount ** torch.arange(count, device=reward.device)
    summed = (torch.nn.functional.pad(reward, (0, count - 1)).unfold(1, count, 1) * weights).sum(-1)
    last = (step + count - 1).minimum(lengths - 1)
    rows = (torch.arange(len(lengths), device=lengths.device)[:, None], last)
    terminated = experience.terminated[rows]
    whole = (step + count <= lengths) | (terminated & (step < lengths))
    if not bool(whole.any()):
        least = f"at least {config.return_steps} steps (return_steps), or one that ends the task"
        raise BadInputError(f"expected an episode of {least}; the longest has {int(lengths.max())}")
    columns = experience.observation, experience.action, summed, experience.next_observation[rows], terminated
    return Transitions(*(column[whole] for column in columns))


_CHECKPOINT_EVERY = 500
_POSITION_OCTAVES = 4


def _position_features(task: Task) -> "PositionFeatures":
    from astra_data.grounding.encoder import PositionFeatures

    return PositionFeatures(_POSITION_OCTAVES if task.plane else 0)


def learn_from_episodes(training: Training) -> tuple[PolicyFile, dict[str, Any]]:
    """Learn by IQL from the target's side of the paired episodes; return the policy, and losses every few updates."""
    from astra_data.policies.networks import ActorCritic, PolicyShape

    config, episodes = _config(training), training.episodes
    if config.temperature and not episodes.has_rewards:
        raise BadInputError(f"{episodes.reference} has no {REWARD}, from which the policy would be learned")
    experience = experience_of(training.task, episodes)
    torch.manual_seed(derive(training.seed, "policy"))
    if training.initial is None:
        shape = PolicyShape(
            observation_size=experience.observation.shape[-1] - _position_features(training.task).size,
            action_size=experience.action.shape[-1],
            memory_size=training.config.memory_size,
            hidden_sizes=training.config.hidden_sizes,
        )
        policy: Policy = ActorCritic(shape).to(training.device)
    else:
        policy = copy.deepcopy(training.initial.policy).requires_grad_(True)
    iql = Iql(policy, experience, config, seed=training.seed)
    logbook = Logbook(training.folder / CHECKPOINT, iql.load_state_dict)
    while not iql.done:
        losses = iql.iterate()
        if iql.updates % 10 == 0 or iql.done:
            shown = "  ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in losses.items())
            note = f"{iql.updates / logbook.stopwatch.seconds:,.0f} updates/s  {shown}"
            training.progress(iql.updates / iql.total_updates, note)
        if iql.updates % _CHECKPOINT_EVERY == 0 or iql.done:
            # No policy acts while learning from recorded episodes, so there is no success rate.
            logbook.points.append({"steps": iql.updates, "success": None, **losses})
            logbook.keep(iql.state_dict())
    return training.learned(policy, None), {**logbook.stopwatch.spent(), "points": logbook.points}


def clone_behavior(training: Training) -> tuple[PolicyFile, dict[str, Any]]:
    """Imitate all recorded actions equally, as IQL does at temperature 0; see `learn_from_episodes`."""
    cloning = _config(training).model_copy(update={"temperature": 0.0, "critic_updates": 1, "return_steps": 1})
    return learn_from_episodes(replace(training, settings=cloning))


def _config(training: Training) -> IqlConfig:
    """Return the settings; a trained policy is tuned by fewer and smaller updates."""
    config = own_settings(training.settings, IqlConfig())
    if training.initial is None:
        return config
    fewer = {"policy_updates": config.fine_tuning_updates, "learning_rate": config.learning_rate / 10}
    return config.model_copy(update=fewer)


def experience_of(task: Task, episodes: PairedEpisodes) -> Experience:
    """Return the target's side of `episodes` as a policy sees it, and sines and cosines of the position for critics."""
    windows = episodes.windows
    features = _position_features(task).to(windows.state.device)
    now, later = (
        torch.cat([without_padding(seen, windows.mask), features(state[..., :2])], dim=-1)
        for state in (windows.state, windows.next_state)
        for seen in [policy_observation(task.objective, state, windows.goal, None)]
    )
    return Experience(
        observation=now,
        previous_action=windows.previous_action,
        action=windows.action,
        lengths=episodes.lengths,
        reward=windows.reward,
        next_observation=later,
        terminated=episodes.terminated,
    )


IQL = Method("iql", "IQL", "#D55E00", learn=learn_from_episodes, learns_from="episodes", table=Table("iql", IqlConfig))
BEHAVIOR_CLONING = replace(
    IQL, name="behavior_cloning", title="Behavior cloning", color="#AA4499", learn=clone_behavior
)
DIRECT_TRANSFER_IQL = replace(
    IQL, name="direct_transfer_iql", title="Direct transfer + IQL", color="#7B3294", initial="direct_transfer"
)  # fits the critics while the policy is left as it is; then fine-tunes direct transfer's policy, gently
