"""Logs of robots on a plane, ten rows a second, and simulators that step as the robots did."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from astra_data.core.arrays import Floats
from astra_data.worlds.protocols import AbstractSimulator
from astra_data.worlds.task import Task
from astra_data.worlds.walk_through import check_task


def poses_of(forward: Floats, left: Floats, turn: Floats, *, in_world: bool = False) -> Floats:
    """Return x, y and yaw (rows, 3) of speeds along the robot, or along x and y, and rates of turning."""
    yaw = np.cumsum(turn / 10) - turn / 10
    cos, sin = (np.ones(len(yaw)), np.zeros(len(yaw))) if in_world else (np.cos(yaw), np.sin(yaw))
    speeds = np.column_stack([forward * cos - left * sin, forward * sin + left * cos, turn])
    poses: Floats = np.cumsum(speeds / 10, axis=0) - speeds / 10
    return poses


def write(path: Path, names: Sequence[str], *values: Floats) -> Path:
    """Write columns of values with the time before them."""
    table = np.column_stack([np.arange(len(values[0])) / 10, *values])
    np.savetxt(path, table, "%.7f", ",", header=",".join(["time", *names]), comments="")
    return path


def wrapped(poses: Floats) -> Floats:
    """Return x, y and yaw (rows, 3) with the yaw between -π and π, as robots record it."""
    return np.column_stack([poses[:, :2], np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))])


def step_as_logged(task: Task, states: Floats, commands: Floats) -> AbstractSimulator:
    """Assert that `task` is right, and that its simulator steps from each row to the next; return it."""
    assert check_task(task) == []
    simulator, rows = task.make_simulator(len(states) - 1), torch.from_numpy(states).float()
    simulator.reset_to(task.abstraction(rows[:-1]))
    landed = simulator.step(torch.from_numpy(commands[:-1]).float())
    torch.testing.assert_close(landed, task.abstraction(rows[1:]), atol=1e-4, rtol=0)
    return simulator
