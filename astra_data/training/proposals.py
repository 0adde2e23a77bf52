"""Proposals: episodes that might be recorded, and a choice of those that would teach most.

A proposal is a start and commands as `collect` draws them. A committee of corrections says what each step of
it would teach (`grounding.committee`), and proposals are taken one after another, the most instructive first.
Once one is taken, steps of others teach less the closer they come to it: otherwise all would be much the same
(that batches need it: Kirsch et al., 2019, "BatchBALD").
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from astra_data.core.config import AtOnce, Config, Positive
from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, part, silent
from astra_data.core.seeding import derive, generator
from astra_data.grounding.committee import Committee, Rollouts
from astra_data.training.behaviors import HoldTimes, RandomCommands, held_steps
from astra_data.training.recording_plan import PlannedEpisode, RecordingPlan, names_of
from astra_data.worlds.objective import PlanarObjective
from astra_data.worlds.task import Task

_COMPARED_S = 0.5
"""Time between the steps of a proposal that are compared with those of others."""


class SuggestConfig(Config):
    """Which episodes are proposed, and how many of them are suggested."""

    episodes: AtOnce = 20
    """Number of episodes to suggest."""
    max_steps: AtOnce = 500
    """Length of each episode, in control steps."""
    start: Literal["anywhere", "task"] = "anywhere"
    """Where episodes may start: anywhere in the free space, or where the task starts."""
    hold_s: HoldTimes = (0.5, 3.0)
    """Range of the time that a command is held."""
    proposals: AtOnce = Field(default=2000, ge=2)
    """Number of episodes to choose from."""
    reach: Positive = 0.5
    """Distance within which a step close to one of an episode already chosen teaches much less, in standard
    deviations of all proposals' states and commands."""


@dataclass(frozen=True)
class Proposals:
    """N proposals of T steps.

    Attributes:
        start: (N, X). goal: (N, G).
        action: of ±1, (T, N, A).
    """

    start: Tensor
    goal: Tensor
    action: Tensor


@dataclass(frozen=True)
class Suggestion:
    """The proposals that were taken, in order, and what they were chosen from.

    Attributes:
        plan: the episodes, for `collect`.
        proposals: all. rollouts: what the committee expects of them.
        taken: their numbers among all, (E,).
        information: what each was expected to teach, given those before, in nats, (E,).
    """

    plan: RecordingPlan
    proposals: Proposals
    rollouts: Rollouts
    taken: NDArray[np.intp]
    information: NDArray[np.float64]


def suggested(
    task: Task, committee: Committee, config: SuggestConfig, *, seed: int, progress: Progress = silent
) -> Suggestion:
    """Suggest episodes to record next.

    Args:
        task: the task.
        committee: of corrections of its simulator.
        config: what to suggest.
        seed: of the proposals.
        progress: called with the share done and a note.

    Raises:
        BadInputError: more episodes are asked for than proposed, or starts anywhere where there is no maze.
    """
    if config.episodes > config.proposals:
        raise BadInputError(
            f"episodes: expected at most {config.proposals}, the proposals, got {config.episodes}"
        )
    proposals = drawn(task, config, seed)
    torch.manual_seed(derive(seed, "proposed rollouts"))
    rollouts = committee.follow(proposals.start, proposals.goal, proposals.action, part(progress, 0.0, 0.9))
    every = max(1, round(_COMPARED_S / task.timestep_s))
    features = torch.cat([rollouts.state, proposals.action], dim=-1)
    spread = features.flatten(0, 1).std(0).clamp_min(1e-6)
    taken, information = chosen(
        torch.stack([steps.sum(0) for steps in rollouts.expected.split(every)], dim=1),
        (features[::every] / spread).transpose(0, 1),
        config.episodes,
        config.reach,
        part(progress, 0.9, 1.0),
    )
    episodes = tuple(
        planned(task, proposals.start[number], proposals.action[:, number], gained)
        for number, gained in zip(taken.tolist(), information.tolist(), strict=True)
    )
    starts, commands = names_of(task)
    plan = RecordingPlan(
        task=task.name,
        timestep_s=task.timestep_s,
        start_names=starts,
        command_names=commands,
        episodes=episodes,
    )
    return Suggestion(plan, proposals, rollouts, taken, information)


def drawn(task: Task, config: SuggestConfig, seed: int) -> Proposals:
    """Draw proposals as `collect` draws starts, goals and random commands.

    Raises:
        BadInputError: starts are to be anywhere, and there is no maze.
    """
    objective, count = task.objective, config.proposals
    if config.start == "task":
        draw = objective.draw_starts
    elif isinstance(objective, PlanarObjective):
        draw = objective.draw_anywhere
    else:
        raise task.without_maze()
    start = torch.from_numpy(draw(generator(seed, "proposed starts"), count)).float()
    goal = torch.from_numpy(objective.draw_goals(generator(seed, "proposed goals"), count)).float()
    commands = RandomCommands(objective.action_size, held_steps(config.hold_s, task.timestep_s))
    commands.start(range(count), derive(seed, "proposed commands"))
    action = [commands.act(start, goal).clone() for _ in range(config.max_steps)]
    return Proposals(start, goal, torch.stack(action))


def chosen(
    information: Tensor, features: Tensor, count: int, reach: float, progress: Progress = silent
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Take `count` proposals, each the one that teaches most given those that were taken before.

    Args:
        information: of each step that is compared with others, and those up to the next, (N, K).
        features: of each step that is compared, in units in which 1 is far, (N, K, F).
        count: how many to take.
        reach: distance at which a step of a proposal still teaches 1 - exp(-½) of what it would otherwise.
        progress: called with the share done and a note.

    Returns:
        their numbers (count,), and what each was expected to teach then, (count,).
    """
    left = torch.ones_like(information)
    open_ = torch.ones(len(information), dtype=torch.bool)
    taken, gained = [], []
    for number in range(count):
        gains = (information * left).sum(1).masked_fill(~open_, -1.0)
        best = int(gains.argmax())
        taken.append(best)
        gained.append(float(gains[best]))
        open_[best] = False
        near = torch.cdist(features.flatten(0, 1), features[best]).amin(1).view_as(left)
        left = torch.minimum(left, 1.0 - (-0.5 * (near / reach) ** 2).exp())
        progress((number + 1) / count, f"episode {number + 1} of {count}")
    return np.array(taken, dtype=np.intp), np.array(gained)


def planned(task: Task, start: Tensor, action: Tensor, information: float) -> PlannedEpisode:
    """Return the episode of a start (X,) and actions (T, A) of ±1; equal ones in a row are held."""
    commands = task.limits.in_units(action).double().numpy()
    first = np.flatnonzero(np.append(True, (commands[1:] != commands[:-1]).any(axis=1)))
    return PlannedEpisode(
        start=tuple(start.tolist()),
        commands=tuple(tuple(command) for command in commands[first].tolist()),
        hold_steps=tuple(np.diff(np.append(first, len(commands))).tolist()),
        information=information,
    )
