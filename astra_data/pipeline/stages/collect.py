"""Collect: record a behavior in the target environment as a LeRobot dataset."""

import time
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from astra_data.core.config import Config, Count, NotNegative, Share
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, Stopwatch, part, silent
from astra_data.core.seeding import derive
from astra_data.dataset.columns import OUTCOME_COLUMNS
from astra_data.dataset.staging import StagedWriter
from astra_data.dataset.versions import home_of
from astra_data.grounding.files import GROUNDING, TARGET_ENCODER, grounding_at, load_target_encoder
from astra_data.policies.collecting import (
    Behavior,
    HoldTimes,
    MixedBehavior,
    PolicyBehavior,
    RandomCommands,
    StressCommands,
    WallWatch,
    held_steps,
    record,
)
from astra_data.policies.running_policy import POLICY, PolicyFile, running
from astra_data.robots.registry import task_named
from astra_data.worlds.task import Task

_TRAINING_SHARE = 0.8
"""Share of the progress bar for training the suboptimal policy."""
_NUM_ENVS = 200
"""Episodes recorded in one batch."""
_SAC_STEPS, _SAC_EPISODE_STEPS = 300_000, 500
"""SAC's training of a suboptimal policy stops after so many steps, or once test episodes last this long."""
MOST_STEPS = 10**10
"""Upper bound of the steps of a dataset; it would take terabytes."""


class CollectConfig(Config):
    """What to collect; the paper uses 200 episodes of random behavior of up to 500 steps."""

    behavior: Literal["random", "stress", "policy", "suboptimal_ppo", "suboptimal_sac"] = "random"
    """"random": commands drawn from U[-1, 1] per axis, each held for a while. "stress": commands at the
    bounds that often reverse, to provoke failures. "policy": a saved policy. "suboptimal_ppo",
    "suboptimal_sac": a policy trained in the target and stopped early. Policies sample their actions."""
    episodes: Count = 200
    """Number of episodes: with `least_steps` the maximum."""
    least_steps: Count | None = Field(default=None, exclude_if=lambda steps: steps is None)
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
    random_share: Share = Field(default=0.0, exclude_if=lambda share: not share)
    """Fraction of a policy's episodes that get random commands instead, spread evenly over the dataset."""
    policy: str | None = None
    """Folder of the saved policy, as written by the stage `train`."""
    grounding: str | None = None
    """Folder of the grounding that computes the latent for the saved policy, if it has one."""
    target_encoder: str | None = None
    """Folder of the aligned target encoder; by default the grounding's own encoder is used."""

    @model_validator(mode="after")
    def _fits_the_behavior(self) -> Self:
        if self.behavior == "policy" and self.policy is None:
            raise ValueError('behavior "policy": expected the folder of a trained policy as policy, got none')
        artifacts = ("policy", "grounding", "target_encoder")
        given = [name for name in artifacts if getattr(self, name) is not None]
        if self.behavior != "policy" and given:
            raise ValueError(f'{", ".join(given)}: expected behavior "policy", got "{self.behavior}"')
        if self.random_share and self.behavior in {"random", "stress"}:
            raise ValueError(f'random_share: expected the behavior of a policy, got "{self.behavior}"')
        if self.episodes * self.max_steps > MOST_STEPS:
            raise ValueError(
                f"episodes: {self.episodes} of up to {self.max_steps} steps take terabytes: expected at most "
                f"{MOST_STEPS} steps in total"
            )
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
        BadInputError: the task is unknown, `out` exists, or an artifact of the behavior is missing.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import collect
        >>> from astra_data.pipeline.stages.collect import CollectConfig
        >>> drives = collect("antmaze-umaze", CollectConfig(episodes=2, max_steps=5), out=Path("drives"))
    """
    world = task_named(task)
    description = _description(world, config, seed, name)
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
        if config.random_share:
            behavior = MixedBehavior(behavior, _random(world, config, RandomCommands), config.random_share)
        stopwatch, trained = Stopwatch(metadata.get("spent")), time.perf_counter()
        steps = _record(world, config, behavior, seed, writer, num_threads, part(progress, share, 1.0))
        if config.least_steps:
            _keep(config.least_steps, writer)
        rate = steps / (time.perf_counter() - trained)
        returns, successes = zip(*((m["return"], m["success"]) for m in writer.staged.values()), strict=True)
        metadata |= {"return_mean": float(np.mean(returns)), "success_rate": float(np.mean(successes))}
        writer.made = {"behavior": metadata, **stopwatch.spent(), "target_steps_per_second": rate}
    note = f"return {metadata['return_mean']:.2f}, success {metadata['success_rate']:.2f}"
    progress(1.0, f"{len(returns)} episodes, {note}, {rate:,.0f} target steps/s")
    return folder


def _description(world: Task, config: CollectConfig, seed: int, name: str | None) -> dict[str, Any]:
    """Return what the dataset says of itself."""
    files = _saved_files(config).items()
    saved = {f"{kind}_sha256": file_digest(path) for kind, path in files if path.is_file()}
    behaviors = config.behavior + ("-and-random" if config.random_share else "")
    return {
        "name": name or f"{world.name}-{behaviors}-seed{seed}".replace("_", "-"),
        "version": "1.0.0",
        "stage": "collect",
        "config": config.model_dump(mode="json") | saved,
        "seeds": {"collect": seed, "subset": derive(seed, "subset")},
        "environment": {"id": world.name, "timestep_s": world.timestep_s, **world.facts},
    }


def _record(
    world: Task,
    config: CollectConfig,
    behavior: Behavior,
    seed: int,
    writer: StagedWriter,
    num_threads: int | None,
    progress: Progress,
) -> int:
    """Record the episodes that `writer` lacks, `_NUM_ENVS` at once; return the number of their steps."""
    steps = 0
    for first in range(0, config.episodes, _NUM_ENVS):
        rows = range(first, min(first + _NUM_ENVS, config.episodes))
        before = sum(length for staged, length in writer.lengths.items() if staged < first)
        if config.least_steps and before >= config.least_steps:
            break
        if writer.staged.keys() >= set(rows):
            continue
        batch_seed = derive(seed, f"episodes from {first}") if first else seed
        anywhere = world.plane is not None if config.start is None else config.start == "anywhere"
        drawn = derive(batch_seed, "collect")
        env = world.target(len(rows), seed=drawn, start_anywhere=anywhere, num_threads=num_threads)
        env.reset()
        behavior.start(rows, batch_seed)
        shown = part(progress, rows.start / config.episodes, rows.stop / config.episodes)
        steps += record(world, env, behavior, rows, writer, max_steps=config.max_steps, seed=seed, progress=shown)
    return steps


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
        return _random(task, config, commands), {}
    if config.behavior.startswith("suboptimal"):
        from astra_data.policies.collecting import suboptimal_by_ppo, suboptimal_by_sac  # noqa: PLC0415 - slow to import

        by = partial(suboptimal_by_sac, steps=_SAC_STEPS, episode_steps=_SAC_EPISODE_STEPS)
        if config.behavior == "suboptimal_ppo":
            by = partial(suboptimal_by_ppo, steps=config.ppo_steps)
        policy, metadata = by(task, seed=seed, folder=writer.folder, num_threads=num_threads, progress=progress)
        writer.policy = writer.folder / POLICY
        policy.save(writer.policy)
        metadata["policy_sha256"] = file_digest(writer.policy)
        return PolicyBehavior(running(task, policy)), metadata
    files = _saved_files(config)
    trained = PolicyFile.load(files["policy"])
    encoder = load_target_encoder(files["target_encoder"]) if "target_encoder" in files else None
    acts = running(task, trained, grounding_at(files.get("grounding")), encoder)
    return PolicyBehavior(acts), {"policy_dataset": trained.dataset}


def _random(task: Task, config: CollectConfig, commands: type[RandomCommands]) -> RandomCommands:
    watch = WallWatch(task, config.clearance_m) if config.clearance_m else None
    return commands(task.objective.action_size, held_steps(config.hold_s, task.timestep_s), watch)


def _saved_files(config: CollectConfig) -> dict[str, Path]:
    names = {"policy": POLICY, "grounding": GROUNDING, "target_encoder": TARGET_ENCODER}
    return {kind: Path(folder) / name for kind, name in names.items() if (folder := getattr(config, kind))}
