"""Collect: random behaviour in the target environment, stored as a LeRobot dataset."""

import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from astra_data.columns import (
    ACTION,
    DONE,
    GOAL,
    NEXT_STATE,
    OUTCOME_COLUMNS,
    REWARD,
    STATE,
    SUCCESS,
    TERMINATED,
    TRUNCATED,
    Array,
    Episode,
)
from astra_data.dataset.writer import DatasetWriter
from astra_data.progress import Progress
from astra_data.recipe import Config, Count, NotNegative
from astra_data.results.provenance import machine
from astra_data.seeding import derive, generator
from astra_data.tasks import Task, task_named


class CollectConfig(Config):
    """What to collect; 200 episodes of random behaviour of up to 500 steps are the paper's."""

    behavior: Literal["random"] = "random"
    """"random": commands drawn from U[-1, 1]² m/s, each held for a while."""
    episodes: Count = 200
    """Recorded side by side."""
    max_steps: Count = 500
    """Longest episode, in control steps; longer ones are truncated."""
    hold_s: tuple[NotNegative, NotNegative] = (0.5, 3.0)
    """How long a random command is held; not in the paper."""


def collect(
    task: str,
    config: CollectConfig,
    *,
    seed: int,
    out: Path,
    progress: Progress,
    num_threads: int | None = None,
) -> None:
    """Record episodes that start anywhere in the free space and write them to `out`.

    The physics runs on `num_threads`, by default one per core; the outcome is the same with any number.

    Raises:
        BadInputError: the task is unknown or `out` exists.
    """
    world = task_named(task)
    began = time.perf_counter()
    description = {
        "name": f"{task}-{config.behavior}",
        "stage": "collect",
        "config": config.model_dump(mode="json"),
        "seeds": {"collect": seed, "subset": derive(seed, "subset")},
        "environment": {"id": task, "integrator": "RK4", "timestep_s": world.timestep_s, "leg_scale": 1.0},
    }
    with DatasetWriter(
        out,
        [*world.state_columns, *OUTCOME_COLUMNS],
        fps=world.fps,
        task=world.instruction,
        description=description,
        subset_seed=derive(seed, "subset"),
    ) as writer:
        columns, lengths = _record(world, config, seed, num_threads, progress)
        rate = float(lengths.sum() / (time.perf_counter() - began))
        for index, length in enumerate(lengths):
            values = {name: stacked[:length, index] for name, stacked in columns.items()}
            writer.add(
                Episode(
                    uid=index,
                    columns=values,
                    metadata={
                        "success": bool(values[SUCCESS].any()),
                        "toppled": bool(values[TERMINATED][-1] and not values[SUCCESS][-1]),
                        "return": float(values[REWARD].sum(dtype=np.float64)),
                        "seed": seed,
                    },
                )
            )
        seconds = time.perf_counter() - began
        writer.made = {"wall_seconds": seconds, "target_steps_per_second": rate, "machine": machine()}
    progress(1.0, f"{len(lengths)} episodes, {rate:,.0f} target steps/s")


def _record(
    task: Task, config: CollectConfig, seed: int, num_threads: int | None, progress: Progress
) -> tuple[dict[str, Array], Array]:
    """Return columns (T, B, ...) of all episodes side by side, and their lengths (B,)."""
    count = config.episodes
    env = task.target(count, seed=derive(seed, "collect"), start_anywhere=True, num_threads=num_threads)
    rng = generator(seed, "behavior")
    env.reset()
    low, high = (max(1, round(seconds / task.timestep_s)) for seconds in config.hold_s)
    command = np.zeros((count, 2))
    hold = np.zeros(count, dtype=int)
    lengths = np.zeros(count, dtype=int)
    active = torch.ones(count, dtype=torch.bool)
    rows: dict[str, list[Any]] = {}
    began = time.perf_counter()
    for step in range(config.max_steps):
        due = np.flatnonzero(hold == 0)
        command[due] = rng.uniform(-1.0, 1.0, (len(due), 2))
        hold[due] = rng.integers(low, high + 1, len(due))
        hold -= 1
        action = torch.from_numpy(command).float()
        state = env.state
        outcome = env.step(action, active)
        truncated = torch.full((count,), step == config.max_steps - 1) & ~outcome.terminated
        row = {
            STATE: state,
            GOAL: env.goal.clone(),
            ACTION: action,
            NEXT_STATE: env.state,
            REWARD: outcome.reward,
            TERMINATED: outcome.terminated,
            TRUNCATED: truncated,
            DONE: outcome.terminated | truncated,
            SUCCESS: outcome.success,
        }
        for name, values in row.items():
            rows.setdefault(name, []).append(values.numpy())
        lengths += active.numpy()
        active &= ~outcome.terminated
        rate = lengths.sum() / (time.perf_counter() - began)
        progress((step + 1) / config.max_steps, f"{rate:,.0f} target steps/s")
        if not active.any():
            break
    return {name: np.stack(values) for name, values in rows.items()}, lengths
