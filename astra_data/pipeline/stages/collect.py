"""Collect: record a behavior in the target environment as a LeRobot dataset."""

import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, model_validator

from astra_data.core.arrays import Floats, Ints, as_column
from astra_data.core.checkpoint import Logbook
from astra_data.core.config import Config, Count, NotNegative, in_order
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.core.progress import Progress, Stopwatch, part, silent
from astra_data.core.seeding import derive, generator
from astra_data.dataset import columns as names
from astra_data.dataset.columns import OUTCOME_COLUMNS, Array, Episode
from astra_data.dataset.inspection import outcome_of
from astra_data.dataset.versions import home_of
from astra_data.dataset.writer import StagedWriter
from astra_data.policies.episodes import Act, ObservedTargetEnv, in_target
from astra_data.policies.ppo import Ppo, PpoConfig
from astra_data.policies.running_policy import POLICY, Observed, PolicyFile, RunningPolicy, running
from astra_data.policies.sac import Sac, SacConfig
from astra_data.robots.registry import task_named
from astra_data.worlds.protocols import TargetEnv
from astra_data.worlds.task import Task

_FORESIGHT_S = 1.0
_CHOICES = 16  # random commands to choose one from that stays clear of walls

HoldTimes = Annotated[tuple[NotNegative, NotNegative], AfterValidator(in_order)]
"""The shortest and the longest time for which a random command is held."""
_PPO_ENVS = 128
_SAC_ENVS = 32  # target environments stepped side by side
_SAC = SacConfig(buffer_size=1_000_000)  # settings with which the humanoid learns to stay up; its rewards are 5 a step
_SAC_SIZES = (256, 256)  # hidden layers of actor and critics
_TEST_EPISODES = 32  # test episodes after each iteration
_TRAINING_SHARE = 0.8  # share of the progress bar for training the suboptimal policy
_NUM_ENVS = 200  # episodes recorded in one batch
_SAC_STEPS, _SAC_EPISODE_STEPS = 300_000, 500  # steps of the training; it stops where test episodes last this long
MOST_STEPS = 10**10  # upper bound of the steps of a dataset; it would take terabytes


def clearance(task: Task, state: Tensor, commands: Floats) -> Floats:
    """Predict the least clearance in m (B, K) within a second of `commands` (B, K, A) held from `state` (B, S)."""
    count, choices, _ = commands.shape
    simulator = task.simulator(count * choices)
    simulator.reset_to(task.abstraction(state).repeat_interleave(choices, dim=0))
    action = torch.from_numpy(commands).float().flatten(0, 1)
    nearest = np.full((count, choices), np.inf)
    for _ in range(round(_FORESIGHT_S / task.timestep_s)):
        position = simulator.step(action)[:, :2].double().numpy()
        nearest = np.minimum(nearest, task.maze.clearance(position).reshape(count, choices))
    return nearest


class RandomCommands:
    """Commands from U[-1, 1] per axis, each held for a random number of steps."""

    def __init__(self, task: Task, hold_steps: tuple[int, int], clearance_m: float = 0.0) -> None:
        """Hold commands (A,) for `hold_steps` (fewest, most), or until they lead closer to walls than `clearance_m`."""
        self._task, self._hold_steps, self._clearance_m = task, hold_steps, clearance_m
        self._size = task.objective.action_size

    def begin(self, count: int, seed: int) -> Act:
        """Begin new episodes of so many robots; return what acts in them."""
        self._rng = generator(seed, "behavior")
        self._command = np.zeros((count, self._size))
        self._left = np.zeros(count, dtype=int)
        return self.act

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return commands (B, A); goals are ignored, and so are states unless walls are watched for."""
        over = self._left == 0
        if self._clearance_m:
            over |= clearance(self._task, state, self._command[:, None])[:, 0] < self._clearance_m
        due = np.flatnonzero(over)
        choices, chosen = self._proposed(due, _CHOICES if self._clearance_m else 1), np.zeros(len(due), dtype=int)
        if self._clearance_m:  # the first that stays clear of walls, or the clearest
            chosen = clearance(self._task, state[due], choices).clip(max=self._clearance_m).argmax(axis=1)
        self._command[due] = choices[np.arange(len(due)), chosen]
        self._left[due] = self._times(len(due))
        self._left -= 1
        return torch.from_numpy(self._command).float()

    def _proposed(self, due: NDArray[np.intp], choices: int) -> Floats:
        """Draw `choices` commands (n, K, A) for each of the robots `due` (n,)."""
        return self._rng.uniform(-1.0, 1.0, (len(due), choices, self._size))

    def _times(self, count: int) -> Ints:
        """Draw for how many steps `count` commands are held, (count,)."""
        fewest, most = self._hold_steps
        return self._rng.integers(fewest, most + 1, count)


class StressCommands(RandomCommands):
    """Commands that seek failures: at the bounds, half of them reversed, held for log-uniform times."""

    def _proposed(self, due: NDArray[np.intp], choices: int) -> Floats:
        drawn = super()._proposed(due, choices)
        drawn /= np.abs(drawn).max(axis=-1, keepdims=True)
        before = self._command[due, None]
        is_reversed = (self._rng.random((len(due), choices, 1)) < 0.5) & before.any(axis=-1, keepdims=True)
        return np.where(is_reversed, -before, drawn)

    def _times(self, count: int) -> Ints:
        fewest, most = self._hold_steps
        drawn = np.exp(self._rng.uniform(np.log(fewest), np.log(most + 1), count))
        return drawn.astype(np.int64).clip(fewest, most)


def begin_drawing(policy: RunningPolicy, count: int, seed: int) -> Act:
    """Begin new episodes of a policy that draws its actions from its distribution, as it does in training."""
    policy.start(count, torch.Generator().manual_seed(derive(seed, "behavior")))
    return policy.act


Behavior = Callable[[int, int], Act]  # begins so many new episodes with a seed, and returns what acts in them


def record(
    task: Task,
    env: TargetEnv,
    act: Act,
    rows: range,
    writer: StagedWriter,
    *,
    max_steps: int,
    seed: int,
    progress: Progress,
) -> int:
    """Record the episodes `rows` as one batch, staging each new one when it ends; return the number of steps."""
    active, began = torch.ones(len(rows), dtype=torch.bool), time.perf_counter()
    columns, steps = dict[str, Array](), 0
    for step in range(max_steps):
        state, goal = env.state, env.goal.clone()
        action = act(state, goal)
        outcome = env.step(action, active)
        ended = outcome.terminated
        truncated = torch.full_like(ended, step == max_steps - 1) & ~ended
        row = ({names.GOAL: goal} if goal.shape[1] else {}) | {
            names.STATE: state,
            names.ACTION: task.limits.in_units(action),
            names.NEXT_STATE: env.state,
            names.REWARD: outcome.reward,
            names.TERMINATED: ended,
            names.TRUNCATED: truncated,
            names.DONE: ended | truncated,
            names.SUCCESS: task.objective.succeeded(outcome.success, ended & ~outcome.success, step + 1),
        }
        for name, values in row.items():
            if name not in columns:
                columns[name] = np.empty((max_steps, *values.shape), values.numpy().dtype)
            columns[name][step] = values.numpy()
        steps += int(active.sum())
        for index in torch.nonzero(active & row[names.DONE]).squeeze(1).tolist():
            if rows[index] not in writer.staged:
                episode = {name: as_column(values[: step + 1, index]) for name, values in columns.items()}
                writer.add(Episode(rows[index], episode, outcome_of(episode) | {"seed": seed}), rows[index])
        active &= ~row[names.DONE]
        rate = steps / (time.perf_counter() - began)
        progress((step + 1) / max_steps, f"{rate:,.0f} target steps/s")
        if not active.any():
            break
    return steps


type Judge = Callable[[Mapping[str, float]], tuple[float, str]]
"""Given the figures of an iteration, returns the share done and a note."""


def suboptimal_by_ppo(
    task: Task, *, steps: int, seed: int, folder: Path, num_threads: int | None, progress: Progress
) -> tuple[PolicyFile, dict[str, Any]]:
    """Train a policy without memory on φ of the target's state, for `steps`; resume from a checkpoint in `folder`."""
    from astra_data.policies.networks import ActorCritic, PolicyShape

    torch.manual_seed(derive(seed, "suboptimal policy"))
    world = ObservedTargetEnv(task, _PPO_ENVS, num_threads=num_threads)
    policy = ActorCritic(PolicyShape(world.observation_size, world.action_size))
    ppo = Ppo(world, policy, PpoConfig(total_steps=steps), horizon=task.objective.horizon, seed=seed)

    def judge(figures: Mapping[str, float]) -> tuple[float, str]:
        return ppo.steps / steps, f"reward per step {figures['reward']:.3f}"

    return _trained(ppo, world, judge, folder, progress, "abstract")


def suboptimal_by_sac(
    task: Task, *, steps: int, episode_steps: int, seed: int, folder: Path, num_threads: int | None, progress: Progress
) -> tuple[PolicyFile, dict[str, Any]]:
    """Train one on the full state, until episodes last `episode_steps` on average, or for `steps`."""
    from astra_data.policies.networks import PolicyShape, SoftActor

    if not task.objective.is_lasting:
        raise BadInputError(f"in {task.name} good episodes are short: use 'suboptimal_ppo'")
    torch.manual_seed(derive(seed, "suboptimal policy"))
    world = ObservedTargetEnv(task, _SAC_ENVS, observed="full", num_threads=num_threads)
    actor = SoftActor(PolicyShape(world.observation_size, world.action_size, hidden_sizes=_SAC_SIZES))
    config = _SAC.model_copy(update={"total_steps": steps})
    sac = Sac(world, actor, config, horizon=task.objective.horizon, seed=seed)
    running = RunningPolicy(task, actor, observed="full")

    def judge(figures: Mapping[str, float]) -> tuple[float, str]:
        trial = derive(seed, f"trial {sac.steps}")  # tested episodes last longer than those of the training

        def begin(goal: Tensor) -> Act:
            return begin_drawing(running, len(goal), trial)

        lasted = fmean(in_target(task, begin, _TEST_EPISODES, derive(trial, "starts"), num_threads=num_threads).steps)
        return max(sac.steps / steps, lasted / episode_steps), f"episodes last {lasted:.0f} steps"

    return _trained(sac, world, judge, folder, progress, "full")


def _trained(
    learner: Ppo | Sac, world: ObservedTargetEnv, judge: Judge, folder: Path, progress: Progress, observed: Observed
) -> tuple[PolicyFile, dict[str, Any]]:
    """Train until `judge`, given the figures of an iteration, returns a share done of 1, with a note."""

    def go_on(state: dict[str, Any]) -> None:
        observation = world.load_state_dict(state["world"])
        learner.load_state_dict(state["learner"], observation, goes_on=bool(state["world"]))

    logbook = Logbook(folder / "training.pt", go_on)
    share = logbook.points[-1]["share"] if logbook.points else 0.0
    while share < 1.0:
        share, note = judge(learner.iterate())
        logbook.points.append({"steps": learner.steps, "share": share})
        rate = learner.steps / logbook.stopwatch.seconds
        progress(min(1.0, share), f"training the behavior: {rate:,.0f} steps/s  {note}")
        if logbook.is_due or share >= 1.0:
            logbook.keep({"learner": learner.state_dict(), "world": world.state_dict()})
    policy, config = learner.policy.requires_grad_(False), learner.config.model_dump(mode="json")
    settings = {"num_envs": learner.env.num_envs, "hidden_sizes": list(policy.shape.hidden_sizes), **config}
    metadata = {"trained_steps": learner.steps, "learner": settings, "spent": logbook.stopwatch.spent()}
    return PolicyFile(policy, None, None, None, observed), metadata


class CollectConfig(Config):
    """What to collect; the paper uses 200 episodes of random behavior of up to 500 steps."""

    behavior: Literal["random", "stress", "suboptimal_ppo", "suboptimal_sac"] = "random"
    """"random": commands drawn from U[-1, 1] per axis, each held for a while. "stress": commands at the
    bounds that often reverse, to provoke failures. "suboptimal_ppo", "suboptimal_sac": a policy trained in
    the target and stopped early, which samples its actions."""
    episodes: Count = 200
    """Number of episodes: with `least_steps` the maximum."""
    least_steps: Count | None = None
    """Record only as many episodes as it takes to reach this many steps in total, so that datasets of
    different behaviors have the same size."""
    max_steps: Count = 500
    """Maximum steps per episode; longer episodes are truncated."""
    start: Literal["anywhere", "task"] | None = None
    """Where episodes start: anywhere in the free space (with a ball, near it), or where the task does; by
    default anywhere if the task has a maze."""
    hold_s: HoldTimes = (0.5, 3.0)
    """Range of the time that a random command is held; not in the paper."""
    clearance_m: NotNegative = 0.0
    """Replace a random command when it would lead closer to a wall than this within a second, as a person
    steering the robot would; 0: never."""
    ppo_steps: Count = 300_000
    """Environment steps after which the PPO training of the suboptimal policy stops."""

    @model_validator(mode="after")
    def _fits_a_disk(self) -> Self:
        if self.episodes * self.max_steps > MOST_STEPS:
            fault = f"{self.episodes} of up to {self.max_steps} steps take terabytes"
            raise ValueError(f"episodes: {fault}: expected at most {MOST_STEPS} steps in total")
        return self


def collect(
    task: str,
    config: CollectConfig = CollectConfig(),
    *,
    seed: int = 0,
    out: Path | None = None,
    progress: Progress = silent,
    num_threads: int | None = None,
    name: str | None = None,
    resume: bool = True,
) -> Path:
    """Record episodes in the target; return the dataset's folder, by default its place at home.

    The outcome is the same with any `num_threads` of the physics. By default the `name` is made of task, behavior
    and seed. `resume` keeps the finished episodes of an interrupted call and records the rest.

    Raises:
        BadInputError: the task is unknown, or `out` exists.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import collect
        >>> from astra_data.pipeline.stages.collect import CollectConfig
        >>> drives = collect("antmaze-umaze", CollectConfig(episodes=2, max_steps=5), out=Path("drives"))
    """
    world = task_named(task)
    description = {
        "name": f"{world.name}-{config.behavior}-seed{seed}".replace("_", "-") if name is None else name,
        "version": "1.0.0",
        "stage": "collect",
        "config": config.model_dump(mode="json"),
        "seeds": {"collect": seed, "subset": derive(seed, "subset")},
        "environment": {"id": world.name, "timestep_s": world.timestep_s, **world.facts},
    }
    folder = out or home_of(description)
    with StagedWriter(
        folder,
        [*world.state_columns, *OUTCOME_COLUMNS],
        fps=world.fps,
        task=world.instruction,
        description=description,
        subset_seed=derive(seed, "subset"),
        resume=resume,
    ) as writer:
        share = _TRAINING_SHARE if config.behavior.startswith("suboptimal") else 0.0
        training = part(progress, 0.0, share)
        behavior, metadata = _behavior(world, config, seed, writer, num_threads, training)
        stopwatch, trained, steps = Stopwatch(metadata.get("spent")), time.perf_counter(), 0
        anywhere = world.plane is not None if config.start is None else config.start == "anywhere"
        for first in range(0, config.episodes, _NUM_ENVS):
            rows = range(first, min(first + _NUM_ENVS, config.episodes))
            before = sum(length for staged, length in writer.lengths.items() if staged < first)
            if config.least_steps and before >= config.least_steps:
                break
            if writer.staged.keys() >= set(rows):
                continue
            batch_seed = derive(seed, f"episodes from {first}") if first else seed
            drawn = derive(batch_seed, "collect")
            env = world.target(len(rows), seed=drawn, start_anywhere=anywhere, num_threads=num_threads)
            env.reset()
            act = behavior(len(rows), batch_seed)
            shown = part(part(progress, share, 1.0), rows.start / config.episodes, rows.stop / config.episodes)
            steps += record(world, env, act, rows, writer, max_steps=config.max_steps, seed=seed, progress=shown)
        if config.least_steps:
            _keep(config.least_steps, writer)
        rate = steps / (time.perf_counter() - trained)
        returns, successes = zip(*((m["return"], m["success"]) for m in writer.staged.values()), strict=True)
        metadata |= {"return_mean": float(np.mean(returns)), "success_rate": float(np.mean(successes))}
        writer.made = {"behavior": metadata, **stopwatch.spent()}
    note = f"return {metadata['return_mean']:.2f}, success {metadata['success_rate']:.2f}"
    progress(1.0, f"{len(returns)} episodes, {note}, {rate:,.0f} target steps/s")
    return folder


def _keep(least_steps: int, writer: StagedWriter) -> None:
    """Keep the first episodes that have `least_steps` together."""
    kept = sum(writer.lengths.values())
    if kept < least_steps:
        got, advice = f"got {kept} in {len(writer.staged)} episodes", f"raise episodes, and delete {writer.folder}"
        raise BadInputError(f"least_steps: expected {least_steps}, {got}: {advice}")
    for position, steps in sorted(writer.lengths.items(), reverse=True):
        kept -= steps
        if kept < least_steps:
            break
        writer.drop(position)


def _behavior(
    task: Task, config: CollectConfig, seed: int, writer: StagedWriter, num_threads: int | None, progress: Progress
) -> tuple[Behavior, dict[str, Any]]:
    """Return the behavior and its metadata; a policy trained for it is stored in the dataset."""
    if commands := {"random": RandomCommands, "stress": StressCommands}.get(config.behavior):
        fewest, most = (max(1, round(seconds / task.timestep_s)) for seconds in config.hold_s)
        return commands(task, (fewest, most), config.clearance_m).begin, {}
    by = partial(suboptimal_by_sac, steps=_SAC_STEPS, episode_steps=_SAC_EPISODE_STEPS)
    if config.behavior == "suboptimal_ppo":
        by = partial(suboptimal_by_ppo, steps=config.ppo_steps)
    policy, metadata = by(task, seed=seed, folder=writer.folder, num_threads=num_threads, progress=progress)
    writer.policy = writer.folder / POLICY
    policy.save(writer.policy)
    metadata["policy_sha256"] = file_digest(writer.policy)
    return partial(begin_drawing, running(task, policy)), metadata
