"""Identical commands in the abstract simulator and in the target: the paper's Fig. 1."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from astra_data.worlds.task import Task

_ROBOTS = 60
_COMMANDS = (((0.8, 0.0), 2.0), ((0.0, 0.8), 1.0), ((-0.8, 0.0), 2.0), ((0.0, -0.8), 1.0), ((0.0, 0.0), 2.0))
"""Velocity (±1 per axis) and its duration in s: a closed loop within one maze cell, then a stop."""


@dataclass(frozen=True)
class CommandReplay:
    """T steps of the same commands in the abstract simulator and in the target.

    Attributes:
        time_s: (T,). command: ±1 per axis, (T, 2). simulated: [x, y, vx, vy] after each step, (T, 4).
        target: the same of N robots that start with random headings, (N, T, 4).
    """

    time_s: NDArray[np.float64]
    command: NDArray[np.float64]
    simulated: NDArray[np.float64]
    target: NDArray[np.float64]


def can_replay(task: Task) -> bool:
    """Return whether a task's target can be driven from the start cell by velocities in its plane.

    A robot with a ball turns to it, so its commands are not comparable; a user's robots start where they do.
    """
    planar = task.plane is not None and task.objective.action_size == 2
    return planar and task.ball_index is None and task.make_target is not None


def replay_commands(task: Task) -> CommandReplay:
    """Drive one simulated and 60 target robots from the center of the start cell by the same commands."""
    command = np.concatenate(
        [np.tile(velocity, (round(seconds * task.fps), 1)) for velocity, seconds in _COMMANDS]
    )
    robots = task.target(_ROBOTS, seed=0)
    robots.reset()
    states = robots.state.double().numpy()
    states[:, :2] = task.maze.cell_center(*task.maze.start)
    robots.reset_to(np.arange(_ROBOTS), states)
    simulator = task.simulator(1)
    simulator.reset_to(task.abstraction(robots.state[:1]))
    simulated, target, fallen = [], [], torch.zeros(_ROBOTS, dtype=torch.bool)
    for velocity in torch.from_numpy(command).float():
        simulated.append(simulator.step(velocity.expand(1, 2))[0])
        robots.step(velocity.expand(_ROBOTS, 2))
        target.append(torch.where(fallen[:, None], torch.nan, task.abstraction(robots.state)))
        fallen |= robots.failed
    return CommandReplay(
        time_s=np.arange(1, len(command) + 1, dtype=np.float64) * task.timestep_s,
        command=command,
        simulated=torch.stack(simulated).double().numpy(),
        target=torch.stack(target, dim=1).double().numpy(),
    )
