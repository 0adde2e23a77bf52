"""Train a policy: the inputs of a method's training, and the training of most methods.

Most train by PPO, or by SAC, in the abstract simulator: raw, varied, or corrected by the method's grounding
(Algorithm 2).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Literal, Protocol, Self

import torch
from pydantic import Discriminator, Tag, model_validator
from torch import Tensor

from astra_data.core.artifact import CHECKPOINT
from astra_data.core.config import AtOnce, Config, CountFromZero, Share, choice
from astra_data.core.logbook import Logbook
from astra_data.core.progress import Progress
from astra_data.core.seeding import derive
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding
from astra_data.learning.learner import Learner
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.networks.policy import Policy, PolicyShape
from astra_data.learning.networks.soft_actor import SoftActor
from astra_data.learning.ppo import Ppo, PpoConfig
from astra_data.learning.recorded import Recorded
from astra_data.learning.sac import Sac, SacConfig
from astra_data.training.build_env import (
    EnvConfig,
    Simulation,
    data_starts,
    recorded_steps,
    simulation_of,
    training_env,
)
from astra_data.training.policy_file import PolicyFile
from astra_data.training.ramp import Ramp
from astra_data.training.simulator_env import RewardSource, SimulatorEnv
from astra_data.worlds.batched import BatchedEnv
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation


class TrainConfig(EnvConfig):
    """How policies are trained, except for the learner's own settings."""

    num_envs: AtOnce = 256
    """Environments stepped in parallel."""
    hidden_sizes: tuple[AtOnce, ...] = (64, 64)
    """Hidden layers of actor and critic."""
    memory_size: CountFromZero = 64
    """Size of the policy's own GRU, used if no grounding provides a latent."""
    tries: AtOnce = 1
    """Maximum number of training runs. A policy that does not master its own simulator (in 100 episodes from
    the task's starts, acting by the mean of its actions) is trained again with another seed."""
    least_success: Share = 0.9
    """Success in these episodes at which a simulator is mastered; if no try reaches it, the best one is kept.
    """
    most_of_horizon: Share = 0.85
    """Maximum fraction of the horizon that successful episodes may take; slower policies hardly arrive in
    time."""


class PpoTrainConfig(TrainConfig, PpoConfig):
    """Training by PPO."""

    learner: Literal["ppo"] = "ppo"
    """Proximal policy optimization."""


class SacTrainConfig(TrainConfig, SacConfig):
    """Training by SAC."""

    learner: Literal["sac"]
    """Soft actor-critic."""
    num_envs: AtOnce = 32
    """Environments stepped in parallel."""

    @model_validator(mode="after")
    def _learns_from_one_reward(self) -> Self:
        if self.ramp:
            raise ValueError("ramp: expected 0 with SAC, which learns from rewards of long ago as well")
        return self


def _learner(settings: object) -> str:
    """Return the tag of the model below that `settings` are for; by default PPO."""
    if isinstance(settings, Mapping):
        return choice(str(settings.get("learner", "ppo")))
    return choice(str(getattr(settings, "learner", "ppo")))


AnyTrainConfig = Annotated[
    Annotated[PpoTrainConfig, Tag(choice("ppo"))] | Annotated[SacTrainConfig, Tag(choice("sac"))],
    Discriminator(_learner),
]
"""Training by the `learner` that is named, by default PPO."""


def imitates(config: PpoTrainConfig | SacTrainConfig) -> bool:
    """Return whether the learner also imitates recorded actions."""
    return isinstance(config, SacTrainConfig) and config.imitation_weight > 0


def learner_of(
    config: PpoTrainConfig | SacTrainConfig,
    env: BatchedEnv,
    shape: PolicyShape,
    device: str,
    *,
    horizon: int,
    seed: int,
    recorded: Recorded | None,
) -> Ppo | Sac:
    """Build the learner and a new policy of `shape`; by SAC, it may imitate the `recorded` actions."""
    if isinstance(config, SacTrainConfig):
        actor = SoftActor(shape).to(device)
        return Sac(env, actor, config, horizon=horizon, seed=seed, recorded=recorded)
    policy = ActorCritic(ActorCriticShape(**asdict(shape), clips_mean=config.clipped_mean)).to(device)
    return Ppo(env, policy, config, horizon=horizon, seed=seed)


@dataclass(frozen=True)
class Training:
    """What a method is given to train a policy.

    Attributes:
        task: the task. config: the recipe's `[train]`, or `[plus]`.
        settings: the method's own table of the recipe, if it has one.
        episodes: paired episodes. grounding: of the method; `NO_GROUNDING` where it fits none.
        initial: the policy that the training starts from, if the method names one.
        seed: of all randomness. device: of the networks.
        folder: for checkpoints.
        progress: called with the share done and a note.
        num_threads: of the target's physics, for methods that train in the target; None is one per core.
    """

    task: Task
    config: PpoTrainConfig | SacTrainConfig
    settings: Config | None
    episodes: PairedEpisodes
    grounding: Grounding
    initial: PolicyFile | None
    seed: int
    device: str
    folder: Path
    progress: Progress
    num_threads: int | None = None

    @property
    def simulated_steps(self) -> int:
        """Steps after which simulated episodes are cut off."""
        return self.config.episode_steps or self.task.objective.horizon


Learn = Callable[[Training], tuple[PolicyFile, dict[str, Any]]]
"""Returns the policy and its learning curve."""


class ResumableEnv(BatchedEnv, Protocol):
    """A batched environment in which a training can be resumed.

    Attributes:
        penalty_scale: factor on penalties in the reward, which the training may ramp up.
    """

    penalty_scale: float

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs to continue from here."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        """Continue from `state`; return the observations (B, O)."""
        ...


@dataclass(frozen=True)
class InSimulator:
    """Train in the abstract simulator.

    Attributes:
        reward: where the reward comes from, unless the recipe says.
        ranges: which of the task's ranges the simulator's parameters are drawn from, unless the grounding has
            ranges or the method's own settings are ranges; None where they stay plain.
    """

    reward: RewardSource = "abstract"
    ranges: Literal["randomized", "wide"] | None = None

    def __call__(self, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        """Return the policy and its learning curve."""
        env, simulation = self.world(training)
        memory_size = 0 if env.latent_size else training.config.memory_size
        episodes = training.episodes
        config, recorded = training.config, None
        if imitates(config):
            recorded = recorded_steps(training.task, episodes, training.grounding)
        policy, curve = train_in(env, config, memory_size, training, training.simulated_steps, recorded)
        return PolicyFile(policy, simulation, episodes.reference, episodes.content_hash), curve

    def world(self, training: Training, *, shows_parameters: bool = False) -> tuple[SimulatorEnv, Simulation]:
        """Return the environment to train in, and what a policy file records about it."""
        config, settings = training.config, training.settings
        switches = EnvConfig(**{name: getattr(config, name) for name in EnvConfig.model_fields})
        switches = switches.model_copy(update={"reward": switches.reward or self.reward})
        usual: Variation | None = getattr(training.task.varied, self.ranges) if self.ranges else None
        variation = settings if isinstance(settings, Variation) else usual
        task, episodes, grounding = training.task, training.episodes, training.grounding
        starts = data_starts(task, switches, episodes, grounding)
        simulation = simulation_of(task, switches, episodes, grounding, variation)
        env = training_env(
            task,
            simulation,
            grounding,
            num_envs=config.num_envs,
            device=training.device,
            starts=starts,
            shows_parameters=shows_parameters,
        )
        return env, simulation


def train_in(
    env: ResumableEnv,
    config: PpoTrainConfig | SacTrainConfig,
    memory_size: int,
    training: Training,
    horizon: int,
    recorded: Recorded | None = None,
) -> tuple[Policy, dict[str, Any]]:
    """Train a new policy in `env`; return it and its learning curve.

    The policy has a memory of `memory_size`; episodes are cut off after `horizon` steps. Actions that were
    `recorded` are imitated, if the learner does that.
    """
    torch.manual_seed(derive(training.seed, "policy"))
    shape = PolicyShape(env.observation_size, env.action_size, memory_size, hidden_sizes=config.hidden_sizes)
    learner = learner_of(
        config, env, shape, training.device, horizon=horizon, seed=training.seed, recorded=recorded
    )
    return learner.policy, optimize(learner, env, config.penalty_ramp, training)


def optimize(
    learner: Learner,
    env: ResumableEnv,
    ramp: Ramp,
    training: Training,
    checkpoint_name: str = CHECKPOINT,
) -> dict[str, Any]:
    """Train to the end, from the checkpoint in the folder if there is one; return the learning curve.

    The last checkpoint is left in the folder, for what comes after.
    """

    def go_on(state: dict[str, Any]) -> None:
        world = {name: values.to(training.device) for name, values in state["world"].items()}
        learner.load_state_dict(state["learner"], env.load_state_dict(world), goes_on=bool(world))

    logbook = Logbook(training.folder / checkpoint_name, go_on)
    points, stopwatch, first = logbook.points, logbook.stopwatch, learner.steps
    is_lasting = training.task.objective.is_lasting
    while not learner.done:
        env.penalty_scale = ramp.scale(points, learner.steps, learner.total_steps)
        metrics = learner.iterate()
        # JSON has no NaN: undefined figures, such as the success rate of no episodes, are null.
        known = {name: None if math.isnan(value) else value for name, value in metrics.items()}
        if is_lasting:
            # Success is to last to the horizon, which is not an end here: all ends are failures.
            known["success"] = None
        points.append({"steps": learner.steps, **known})
        rate = learner.steps / stopwatch.seconds
        note = f"{rate:,.0f} steps/s  {lately(points, 'episode_steps' if is_lasting else 'success')}"
        training.progress(learner.steps / learner.total_steps, note)
        if logbook.is_due or learner.done:
            logbook.keep({"learner": learner.state_dict(), "world": env.state_dict()})
    taken, seconds = learner.steps - first, learner.acting.world_seconds
    return {
        "steps_per_second": learner.steps / stopwatch.seconds,
        "simulator_steps_per_second": taken / seconds if taken else None,
        **stopwatch.spent(),
        "points": points,
    }


def lately(points: Sequence[Mapping[str, float | None]], figure: str) -> str:
    """Return a note of the mean of a `figure`, "success" or "episode_steps", over the last `points`."""
    recent = [value for point in points[-10:] if (value := point.get(figure)) is not None]
    if figure == "success":
        return f"success of training episodes {f'{fmean(recent):.2f}' if recent else 'unknown yet'}"
    return f"steps of training episodes {f'{fmean(recent):,.0f}' if recent else 'unknown yet'}"
