"""Recording episodes of a behavior in the target."""

import time

import numpy as np
import torch
from torch import Tensor

from astra_data.core.numbers import as_column
from astra_data.core.progress import Progress
from astra_data.dataset.columns import (
    ACTION,
    DONE,
    GOAL,
    NEXT_STATE,
    REWARD,
    STATE,
    SUCCESS,
    TERMINATED,
    TRUNCATED,
    Array,
    Episode,
)
from astra_data.dataset.endings import outcome_of
from astra_data.dataset.staging import StagedWriter
from astra_data.policies.behaviors import Behavior
from astra_data.worlds.batched import TargetEnv
from astra_data.worlds.task import Task


def record(
    task: Task,
    env: TargetEnv,
    behavior: Behavior,
    rows: range,
    writer: StagedWriter,
    *,
    max_steps: int,
    seed: int,
    progress: Progress,
) -> int:
    """Record the episodes `rows` as one batch, staging each when it ends; return the number of steps.

    Random numbers are drawn for the whole batch, so episodes that are staged already are simulated again,
    with the same outcome, but not written again.

    Args:
        task: of the target.
        env: the target, reset, with a row for each of `rows`.
        behavior: started on these rows.
        rows: numbers of the episodes.
        writer: of the dataset.
        max_steps: after which episodes are truncated.
        seed: that the episodes are said to be of.
        progress: called with the fraction done of this batch.
    """
    active = torch.ones(len(rows), dtype=torch.bool)
    columns: dict[str, Array] = {}
    steps = 0
    began = time.perf_counter()
    for step in range(max_steps):
        row = _step(env, behavior, active, last=step == max_steps - 1)
        row[ACTION] = task.limits.in_units(row[ACTION])
        row[SUCCESS] = task.objective.succeeded(row[SUCCESS], row[TERMINATED] & ~row[SUCCESS], step + 1)
        for name, values in row.items():
            if name not in columns:
                columns[name] = np.empty((max_steps, *values.shape), values.numpy().dtype)
            columns[name][step] = values.numpy()
        steps += int(active.sum())
        for index in torch.nonzero(active & row[DONE]).squeeze(1).tolist():
            if rows[index] not in writer.staged:
                episode = {name: as_column(values[: step + 1, index]) for name, values in columns.items()}
                writer.add(Episode(rows[index], episode, outcome_of(episode) | {"seed": seed}), rows[index])
        active &= ~row[DONE]
        rate = steps / (time.perf_counter() - began)
        progress((step + 1) / max_steps, f"{rate:,.0f} target steps/s")
        if not active.any():
            break
    return steps


def _step(env: TargetEnv, behavior: Behavior, active: Tensor, *, last: bool) -> dict[str, Tensor]:
    state, goal = env.state, env.goal.clone()
    action = behavior.act(state, goal)
    outcome = env.step(action, active)
    truncated = torch.full_like(outcome.terminated, last) & ~outcome.terminated
    goals = {GOAL: goal} if goal.shape[1] else {}
    return goals | {
        STATE: state,
        ACTION: action,
        NEXT_STATE: env.state,
        REWARD: outcome.reward,
        TERMINATED: outcome.terminated,
        TRUNCATED: truncated,
        DONE: outcome.terminated | truncated,
        SUCCESS: outcome.success,
    }
