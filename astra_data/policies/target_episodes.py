"""Run a policy in the target environment."""

import time
from typing import NamedTuple

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, silent
from astra_data.policies.episode_record import EpisodeRecord, Outcome
from astra_data.policies.recorded_range import RecordedRange
from astra_data.policies.simulator_episodes import Begin
from astra_data.worlds.task import Task


class TargetEpisodes(NamedTuple):
    """Episodes in the target.

    Attributes:
        outcome: theirs. filmed: the states (T + 1, S) of the first. rate: target steps/s.
        start_goal: where they began, "start" (B, 2) or with balls (B, 4), and "goal" (B, G).
    """

    outcome: Outcome
    filmed: Tensor
    rate: float
    start_goal: dict[str, Tensor]


def in_target(
    task: Task,
    begin: Begin,
    episodes: int,
    seed: int,
    *,
    leg_scale: float = 1.0,
    num_threads: int | None = None,
    progress: Progress = silent,
    asked: RecordedRange | None = None,
) -> TargetEpisodes:
    """Run so many episodes side by side; starts and goals depend on the seed alone.

    Args:
        task: with a target.
        begin: starts the policy.
        episodes: their number.
        seed: of the target.
        leg_scale: factor on the legs' length, of tasks with the fact `leg_scale`: the ant's.
        num_threads: of the physics, by default one per core; the outcome is the same with any number.
        progress: called with the fraction done and the speed.
        asked: counts commands beyond what was recorded.

    Raises:
        BadInputError: the robot has no legs of another length.
    """
    if leg_scale != 1.0 and "leg_scale" not in task.facts:
        raise BadInputError(
            f"leg_scale: the robot of {task.name} has one length of legs: expected 1, got {leg_scale:g}"
        )
    legs = {} if leg_scale == 1.0 else {"leg_scale": leg_scale}
    env = task.target(episodes, seed=seed, num_threads=num_threads, **legs)
    env.reset()
    start_goal = {"start": env.position.clone(), "goal": env.goal.clone()}
    act = begin(env.goal)
    record = EpisodeRecord(env.position)
    filmed = [env.state[0]]
    began = time.perf_counter()
    for step in range(task.objective.horizon):
        is_filmed = bool(record.active[0])
        action = act(env.state, env.goal)
        if asked is not None:
            asked.count(action, record.active)
        outcome = env.step(action, record.active)
        success = task.objective.succeeded(outcome.success, env.failed, step + 1)
        record.add(env.position, outcome.reward, success, env.failed, env.wall_contact)
        if is_filmed:
            filmed.append(env.state[0])
        rate = record.total_steps / (time.perf_counter() - began)
        progress((step + 1) / task.objective.horizon * 0.99, f"{rate:,.0f} target steps/s")
        if not record.active.any():
            break
    return TargetEpisodes(record.outcome(), torch.stack(filmed), rate, start_goal)
