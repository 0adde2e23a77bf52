"""Training: what a method is given to learn a policy from, and the way that most methods take.

That way is PPO, or SAC, in the abstract simulator: raw, varied, or as the method's grounding makes it
(Algorithm 2).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Literal, Protocol, Self

import torch
from pydantic import Discriminator, Tag, model_validator
from torch import Tensor

from astra_data.core.config import Config, Count, Number, choice
from astra_data.core.logbook import Logbook
from astra_data.core.progress import Progress
from astra_data.core.seeding import derive
from astra_data.grounding.grounding_file import Grounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.learner import Learner
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.networks.policy import Policy, PolicyShape
from astra_data.learning.networks.soft_actor import SoftActor
from astra_data.learning.ppo import Ppo, PpoConfig
from astra_data.learning.recorded import Recorded
from astra_data.learning.sac import Sac, SacConfig
from astra_data.training.build_env import WorldConfig, recorded_steps, training_world, world_parts
from astra_data.training.policy_file import PolicyFile, Simulation
from astra_data.training.simulator_env import RewardSource, SimulatorWorld
from astra_data.worlds.batched import BatchedEnv
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation


class TrainConfig(WorldConfig):
    """How policies are trained, but for the learner's own settings."""

    num_envs: Count = 256
    """Worlds stepped side by side."""
    hidden_sizes: tuple[Count, ...] = (64, 64)
    """Of actor and critic."""
    memory_size: Number = 64
    """Of the policy's own GRU, where no grounding provides a latent."""


class PpoTrainConfig(TrainConfig, PpoConfig):
    """Training by PPO."""

    learner: Literal["ppo"] = "ppo"
    """Proximal policy optimisation."""


class SacTrainConfig(TrainConfig, SacConfig):
    """Training by SAC."""

    learner: Literal["sac"]
    """Soft actor-critic."""
    num_envs: Count = 32
    """Worlds stepped side by side."""

    @model_validator(mode="after")
    def _learns_from_one_reward(self) -> Self:
        if self.ramp:
            raise ValueError("ramp: expected 0 with SAC, which learns from rewards of long ago as well")
        return self


def _learner(settings: object) -> str:
    """Return which of the tables below `settings` are; by default PPO's."""
    if isinstance(settings, Mapping):
        return choice(str(settings.get("learner", "ppo")))
    return choice(str(getattr(settings, "learner", "ppo")))


AnyTrainConfig = Annotated[
    Annotated[PpoTrainConfig, Tag(choice("ppo"))] | Annotated[SacTrainConfig, Tag(choice("sac"))],
    Discriminator(_learner),
]
"""Training as its `learner` says, by default by PPO."""


@dataclass(frozen=True)
class Training:
    """What a method has to learn a policy from.

    Attributes:
        task: the task. config: the recipe's `[train]`, or `[plus]`.
        settings: the method's own table of the recipe, if it has one.
        episodes: paired. grounding: what the method's fit gave, if it fits anything.
        initial: the policy that the method goes on from, if it names one.
        seed: of all randomness. device: of the networks.
        folder: for checkpoints; what is left in it becomes part of the artefact.
        progress: told the share done, the rate and the figure that matters.
        num_threads: of the target's physics, for methods that train in the target; None is one per core.
    """

    task: Task
    config: PpoTrainConfig | SacTrainConfig
    settings: Config | None
    episodes: PairedEpisodes
    grounding: Grounding | None
    initial: PolicyFile | None
    seed: int
    device: str
    folder: Path
    progress: Progress
    num_threads: int | None = None

    @property
    def simulated_steps(self) -> int:
        """After how many steps simulated episodes start anew."""
        return self.config.episode_steps or self.task.objective.horizon


Learn = Callable[[Training], tuple[PolicyFile, dict[str, Any]]]
"""Returns the policy and its learning curve."""


class ResumableEnv(BatchedEnv, Protocol):
    """A world that a training can be resumed in."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return everything that a later `load_state_dict` needs to go on from here."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        """Go on from `state`; return the observations (B, O)."""
        ...


@dataclass(frozen=True)
class InSimulator:
    """Train in the abstract simulator.

    Attributes:
        reward: where the reward comes from, unless the recipe says.
        ranges: which of the task's ranges the simulator's parameters are drawn from, unless a grounding is a
            variation or the method's own settings are one; None where they stay plain.
    """

    reward: RewardSource = "abstract"
    ranges: Literal["randomized", "wide"] | None = None

    def __call__(self, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        """Return the policy and its learning curve."""
        env, simulation = self.world(training)
        memory_size = 0 if env.latent_size else training.config.memory_size
        episodes = training.episodes
        config, recorded = training.config, None
        if isinstance(config, SacTrainConfig) and config.imitation_weight:
            recorded = recorded_steps(training.task, episodes, training.grounding)
        policy, curve = train_in(env, config, memory_size, training, training.simulated_steps, recorded)
        return PolicyFile(policy, simulation, episodes.reference, episodes.content_hash), curve

    def world(
        self, training: Training, *, tells_parameters: bool = False
    ) -> tuple[SimulatorWorld, Simulation]:
        """Return the world to train in, and what a policy file says of it."""
        config, settings = training.config, training.settings
        switches = WorldConfig(**{name: getattr(config, name) for name in WorldConfig.model_fields})
        switches = switches.model_copy(update={"reward": switches.reward or self.reward})
        usual: Variation | None = getattr(training.task.varied, self.ranges) if self.ranges else None
        variation = settings if isinstance(settings, Variation) else usual
        parts = world_parts(training.task, switches, training.episodes, training.grounding, variation)
        env = training_world(
            training.task,
            switches,
            parts,
            training.grounding,
            num_envs=config.num_envs,
            device=training.device,
            tells_parameters=tells_parameters,
        )
        return env, Simulation(parts.thinness, parts.scatter, switches, parts.variation)


def train_in(
    env: ResumableEnv,
    config: PpoTrainConfig | SacTrainConfig,
    memory_size: int,
    training: Training,
    horizon: int,
    recorded: Recorded | None = None,
) -> tuple[Policy, dict[str, Any]]:
    """Train a new policy in `env`; return it and its learning curve.

    The policy has a memory of `memory_size`; episodes start anew after `horizon` steps. SAC imitates what was
    `recorded`.
    """
    torch.manual_seed(derive(training.seed, "policy"))
    sizes = env.observation_size, env.action_size, memory_size
    seed = training.seed
    learner: Ppo | Sac
    if isinstance(config, SacTrainConfig):
        actor = SoftActor(PolicyShape(*sizes, hidden_sizes=config.hidden_sizes)).to(training.device)
        learner = Sac(env, actor, config, horizon=horizon, seed=seed, recorded=recorded)
    else:
        policy = ActorCritic(ActorCriticShape(*sizes, hidden_sizes=config.hidden_sizes)).to(training.device)
        learner = Ppo(env, policy, config, horizon=horizon, seed=seed)
    return learner.policy, optimise(learner, env, config.ramp, training)


def optimise(
    learner: Learner,
    env: ResumableEnv,
    ramp: float,
    training: Training,
    checkpoint_name: str = "checkpoint.safetensors",
) -> dict[str, Any]:
    """Train to the end, from the checkpoint in the folder if there is one; return the learning curve.

    The checkpoint of the end is left in the folder, for what comes after.
    """

    def go_on(state: dict[str, Any]) -> None:
        world = {name: values.to(training.device) for name, values in state["world"].items()}
        learner.load_state_dict(state["learner"], env.load_state_dict(world))

    logbook = Logbook(training.folder / checkpoint_name, go_on)
    points, stopwatch, first = logbook.points, logbook.stopwatch, learner.steps
    is_lasting = training.task.objective.is_lasting
    while not learner.done:
        if isinstance(env, SimulatorWorld):
            env.caution = min(1.0, learner.steps / (learner.total_steps * ramp)) if ramp else 1.0
        metrics = learner.iterate()
        # JSON knows no NaN: what is undefined, such as the success of no episodes, is null.
        known = {name: None if math.isnan(value) else value for name, value in metrics.items()}
        if is_lasting:
            # Horizons pass unseen here: what ended is what failed.
            known["success"] = None
        points.append({"steps": learner.steps, **known})
        rate = learner.steps / stopwatch.seconds
        lately = _lately(points, "episode_steps" if is_lasting else "success")
        note = f"{rate:,.0f} steps/s  {lately}"
        training.progress(learner.steps / learner.total_steps, note)
        if logbook.is_due or learner.done:
            logbook.keep({"learner": learner.state_dict(), "world": env.state_dict()})
    return {
        "steps_per_second": learner.steps / stopwatch.seconds,
        "simulator_steps_per_second": (learner.steps - first) / max(learner.acting.world_seconds, 1e-9),
        **stopwatch.spent(),
        "points": points,
    }


def _lately(points: Sequence[Mapping[str, float | None]], figure: str) -> str:
    """Tell the mean of a `figure`, "success" or "episode_steps", over the last of the `points`."""
    recent = [value for point in points[-10:] if (value := point.get(figure)) is not None]
    if figure == "success":
        return f"success of training episodes {f'{fmean(recent):.2f}' if recent else 'unknown yet'}"
    return f"steps of training episodes {f'{fmean(recent):,.0f}' if recent else 'unknown yet'}"
