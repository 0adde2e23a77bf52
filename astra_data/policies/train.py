"""Train a policy as most methods do: by PPO or SAC in the abstract simulator, raw, varied or corrected."""

import math
import shutil
from collections.abc import Callable, Mapping
from contextlib import chdir
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Discriminator, Tag

from astra_data.core.artifact import CHECKPOINT
from astra_data.core.checkpoint import Logbook
from astra_data.core.config import AtOnce, Config, Count, CountFromZero, Share, choice
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import torch
from astra_data.core.progress import CLOCKS, Progress, part
from astra_data.core.seeding import derive
from astra_data.grounding.files import grounding_at
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.simulator import Grounding
from astra_data.policies.episodes import ObservedTargetEnv, Reached, reached_in_own_world
from astra_data.policies.learner import Learner, SavedPolicy, lately, pace, penalty_scale
from astra_data.policies.ppo import Ppo, PpoConfig
from astra_data.policies.running_policy import POLICY, Observed, PolicyFile
from astra_data.policies.sac import Sac, SacConfig
from astra_data.policies.simulator_env import (
    CHANGE_PENALTY,
    RewardSource,
    Simulation,
    SimulatorEnv,
    WorldConfig,
    command_limit,
    data_starts,
    recorded_steps,
    training_env,
)
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import parts_of, restored

if TYPE_CHECKING:
    from astra_data.policies.gymnasium import WatchedEnv
    from astra_data.policies.networks import Policy


class TrainConfig(Config):
    """How policies are trained, except for the learner's own settings."""

    num_envs: AtOnce = 256
    """Environments stepped in parallel."""
    hidden_sizes: tuple[AtOnce, ...] = (64, 64)
    """Hidden layers of actor and critic."""
    memory_size: CountFromZero = 64
    """Size of the policy's own GRU, used if no grounding provides a latent."""
    data_start_share: Share = 0.5
    """Fraction of the training episodes that start from the middle of a recorded one."""
    episode_steps: Count | None = None
    """Steps after which simulated episodes are truncated and their values bootstrapped; by default the task's
    horizon. In short episodes from recorded states, errors have no time to grow (Janner et al. 2019)."""
    tries: AtOnce = 2
    """Maximum number of training runs. A policy that does not master its own simulator (in 100 episodes from
    the task's starts, acting by the mean of its actions) is trained again with another seed, twice as long."""
    least_success: Share = 0.8
    """Success in these episodes at which a simulator is mastered; if no try reaches it, the best one is kept."""


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


def _learner(settings: object) -> str:
    """Return the tag of the model below that `settings` are for; by default PPO."""
    known = settings.get("learner", "ppo") if isinstance(settings, Mapping) else getattr(settings, "learner", "ppo")
    return choice(str(known))


AnyTrainConfig = Annotated[
    Annotated[PpoTrainConfig, Tag(choice("ppo"))] | Annotated[SacTrainConfig, Tag(choice("sac"))],
    Discriminator(_learner),
]  # training by the `learner` that is named, by default PPO


@dataclass(frozen=True)
class Training:
    """What a method is given to train a policy."""

    task: Task
    config: PpoTrainConfig | SacTrainConfig  # the recipe's `[train]`
    settings: Config | None  # the method's own table of the recipe, if it has one
    episodes: PairedEpisodes
    grounding: Grounding  # of the method; `NO_GROUNDING` where it fits none
    initial: PolicyFile | None  # that the training starts from, if the method names one
    seed: int  # of all randomness
    device: str  # of the networks
    folder: Path  # for checkpoints
    progress: Progress  # called with the share done and a note
    num_threads: int | None = None  # of the target's physics, for methods that train there; None is one per core
    is_plus: bool = False  # whether the row has the plus settings

    @property
    def simulated_steps(self) -> int:
        """Steps after which simulated episodes are cut off."""
        return self.config.episode_steps or self.task.objective.horizon

    def learned(self, policy: "Policy", simulation: Simulation | None, observed: Observed = "abstract") -> PolicyFile:
        """Return the policy as learned from the episodes, in the simulator of a `simulation`, if in one."""
        return PolicyFile(policy, simulation, self.episodes.reference, self.episodes.content_hash, observed)


Learn = Callable[[Training], tuple[PolicyFile, dict[str, Any]]]  # returns the policy and its learning curve
TrainingEnv = SimulatorEnv | ObservedTargetEnv


@dataclass(frozen=True)
class InSimulator:
    """Train in the abstract simulator."""

    reward: RewardSource = "abstract"  # where the reward comes from, but for the plus settings
    ranges: Literal["randomized", "wide"] | None = None
    """Which of the task's ranges the simulator's parameters are drawn from, unless the grounding has ranges; None
    where they stay plain."""

    def __call__(self, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        """Return the policy and its learning curve."""
        env, simulation = self.world(training)
        memory_size = 0 if env.simulator.latent_size else training.config.memory_size
        policy, curve = train_in(env, training.config, memory_size, training, training.simulated_steps)
        return training.learned(policy, simulation), curve

    def world(self, training: Training, *, shows_parameters: bool = False) -> tuple[SimulatorEnv, Simulation]:
        """Return the environment to train in, and what a policy file records about it."""
        config = training.config
        task, episodes, grounding = training.task, training.episodes, training.grounding
        world = WorldConfig(reward=self.reward, data_start_share=config.data_start_share)
        if training.is_plus:  # failures are priced, and changes of the command cost
            changes = {"reward": "priced", "change_penalty": CHANGE_PENALTY}
            world = world.model_copy(update={**changes, "command_limit": command_limit(task, episodes)})
        variation = getattr(task.varied, self.ranges) if self.ranges else None
        starts, simulation = data_starts(task, world, episodes, grounding), Simulation(world, variation)
        make = partial(training_env, task, simulation, grounding, num_envs=config.num_envs, device=training.device)
        return make(starts=starts, shows_parameters=shows_parameters), simulation


def train_in(
    env: TrainingEnv, config: PpoTrainConfig | SacTrainConfig, memory_size: int, training: Training, horizon: int
) -> tuple["Policy", dict[str, Any]]:
    """Train a new policy in `env`, of episodes of at most `horizon` steps; return it and its learning curve."""
    from astra_data.policies.networks import ActorCritic, PolicyShape, SoftActor

    torch.manual_seed(derive(training.seed, "policy"))
    shape = PolicyShape(env.observation_size, env.action_size, memory_size, hidden_sizes=config.hidden_sizes)
    options = {"horizon": horizon, "seed": training.seed}
    learner: Ppo | Sac
    if isinstance(config, SacTrainConfig):
        recorded = recorded_steps(training.task, training.episodes, training.grounding) if training.is_plus else None
        learner = Sac(env, SoftActor(shape).to(training.device), config, **options, recorded=recorded)
    else:
        policy = ActorCritic(shape).to(training.device)
        learner = Ppo(env, policy, config, **options)
    return learner.policy, optimize(learner, env, training)


def optimize(learner: Learner, env: TrainingEnv, training: Training, checkpoint: str = CHECKPOINT) -> dict[str, Any]:
    """Train to the end, or on from the checkpoint; return the curve. Success quickens what is left."""

    def go_on(state: dict[str, Any]) -> None:
        world = {name: values.to(training.device) for name, values in state["world"].items()}
        learner.load_state_dict(state["learner"], env.load_state_dict(world), goes_on=bool(world))

    logbook = Logbook(training.folder / checkpoint, go_on)
    points, stopwatch = logbook.points, logbook.stopwatch
    is_lasting = training.task.objective.is_lasting
    ramps = training.is_plus and isinstance(learner, Ppo) and not is_lasting
    while not learner.done:
        env.penalty_scale = penalty_scale(points, training.config.least_success) if ramps else 1.0
        learner.pace = pace(points, env.penalty_scale)
        metrics = learner.iterate()
        # JSON has no NaN: undefined figures, such as the success rate of no episodes, are null.
        known = {name: None if math.isnan(value) else value for name, value in metrics.items()}
        if is_lasting:
            known["success"] = None  # it is to last to the horizon, which is not an end here: all ends are failures
        points.append({"steps": learner.steps, "share": learner.share, **known})
        rate = learner.steps / stopwatch.seconds
        note = f"{rate:,.0f} steps/s  {lately(points, 'episode_steps' if is_lasting else 'success')}"
        training.progress(learner.share, note)
        if logbook.is_due or learner.done:
            logbook.keep({"learner": learner.state_dict(), "world": env.state_dict()})
    return {**stopwatch.spent(), "points": points}


class TargetConfig(Config):
    """Settings that may differ from `[train]` in the target, whose steps are slow; not in the paper."""

    total_steps: Count | None = None
    """Number of environment steps; by default as in `[train]`."""
    num_envs: AtOnce | None = None
    """Target environments stepped in parallel; by default as in `[train]`."""
    memory_size: CountFromZero | None = None
    """Size of the policy's own GRU; by default as in `[train]`. A policy that observes the full state needs none."""


@dataclass(frozen=True)
class InTarget:
    """Train in the target, from its own rewards."""

    observed: Observed  # whether the policy observes φ of the state or the full state

    def __call__(self, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        """Return the policy and its learning curve."""
        settings, episodes = training.settings, training.episodes
        config = training.config.model_copy(update=settings.model_dump(exclude_none=True) if settings else {})
        env = ObservedTargetEnv(
            training.task,
            config.num_envs,
            observed=self.observed,
            starts=(episodes.steps(episodes.target_state).cpu(), episodes.steps(episodes.windows.goal).cpu()),
            data_start_share=config.data_start_share,
            device=training.device,
            num_threads=training.num_threads,
        )
        policy, curve = train_in(env, config, config.memory_size, training, training.task.objective.horizon)
        return training.learned(policy, None, self.observed), curve


def with_restarts(learn: Learn, training: Training, grounding_file: Path | None) -> tuple[PolicyFile, dict[str, Any]]:
    """Train until a policy masters its own simulator, `tries` times at most, and return the best with its curve.

    Each training is twice as long as the one before: a task that takes longer is more frequent than an unlucky seed.
    """
    config, made = training.config, list[tuple[Reached, PolicyFile, dict[str, Any]]]()
    if config.tries == 1:
        return learn(training)
    grounding = training.grounding if training.device == "cpu" else grounding_at(grounding_file)
    seeds = [training.seed, *(derive(training.seed, f"try {number}") for number in range(1, config.tries))]
    for number, seed in enumerate(seeds):  # the first is the training that there would be without tries
        folder = training.folder / (f"try_{number}" if number else "")
        folder.mkdir(exist_ok=True)
        begins, ends = ((2**count - 1) / (2**config.tries - 1) for count in (number, number + 1))  # of all steps
        noted = part(training.progress, begins, ends, f"try {number + 1} of {config.tries}  ")
        longer = config.model_copy(update={"total_steps": config.total_steps * 2**number})
        policy, curve = learn(replace(training, config=longer, seed=seed, folder=folder, progress=noted))
        policy.save(folder / POLICY)
        saved = PolicyFile.load(folder / POLICY)
        made.append((reached_in_own_world(training.task, saved, grounding, training.seed), policy, curve))
        if made[-1][0].success >= config.least_success:
            break
    _, policy, curve = max(made, key=lambda one: one[0].success)
    tries = [
        {"seed": seed, "success": one.success, "episode_steps": one.steps, "points": of_try["points"]}
        for seed, (one, _, of_try) in zip(seeds, made, strict=False)
    ]
    spent = {clock: sum(of_try[clock] for _, _, of_try in made) for clock in CLOCKS if clock in curve}
    for folder in training.folder.glob("try_*"):
        shutil.rmtree(folder)
    return policy, curve | spent | {"tries": tries}


@dataclass(frozen=True, kw_only=True)
class UserLearner(InSimulator):
    """Train in the abstract simulator by a function of the user's."""

    learn: Callable[["WatchedEnv", Training], SavedPolicy]
    """Given the environment, a vector environment of Gymnasium, and the training, which has the recipe's settings
    (`training.config.total_steps`) and the seed, returns the policy. A hand-written one needs no step."""
    policy: type[SavedPolicy]  # the class of what it returns

    def __call__(self, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        """Return the policy and its learning curve."""
        if training.device != "cpu":
            raise BadInputError(
                f"--device {training.device}: a learner of your own gets an environment of numpy arrays, "
                "expected --device cpu; run the recipe again with it, finished artifacts are kept"
            )
        from astra_data.policies.gymnasium import WatchedEnv
        from astra_data.policies.networks import UserPolicy

        env, simulation = self.world(training)
        watched = WatchedEnv(env, training)
        torch.manual_seed(derive(training.seed, "policy"))
        with chdir("."):  # the user's code may leave it
            learned = self.learn(watched, training)
        if not isinstance(learned, self.policy):
            raise BadInputError(f"learn returned a {type(learned).__name__}, expected a {self.policy.__name__}")
        watched.finish()
        sizes, seen = (env.observation_size, env.action_size), env.reset()
        own, (tensors, metadata) = UserPolicy(learned, *sizes), parts_of(learned)
        again = UserPolicy(restored(self.policy, dict(tensors), metadata), *sizes)
        acted, then, written = own.act(seen), own.act(seen), again.act(seen)
        if torch.equal(acted, then) and not torch.allclose(acted, written, atol=1e-6):
            raise BadInputError(
                f"{own.name}.from_file: actions of what it returns are up to {(written - acted).abs().max():.3g} "
                "from those of what learn returned: expected what to_file wrote"
            )
        return training.learned(own, simulation), {"points": watched.points}
