"""Logs of robots on a plane, ten rows a second, from what they were told."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from astra_data.core.arrays import Floats


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
