"""Logs of toy joints in the form of PACE's: they follow targets late, with inertia, damping and a sag."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from astra_data.studies.joints import Joints
from astra_data.studies.recordings import Piece

FPS = 400
NAMES = ("LF_HAA", "LF_HFE", "LF_KFE")
STIFFNESS, DAMPING, LATE_ROWS, SAG = 900.0, 40.0, 6, 0.03
"""Per unit of inertia, in 1/s² and 1/s; and the pull of gravity, in rad."""


def targets(rows: int, seed: int) -> NDArray[np.float64]:
    """Return chirps (rows, 3) from 0.1 to 8 Hz, each joint with its own phase, direction and scale."""
    rng = np.random.default_rng(seed)
    time = np.arange(rows) / FPS
    phase = 2 * np.pi * (0.1 * time + 0.5 * 7.9 / time[-1] * time**2)
    chirp = np.sin(phase[:, None] + rng.uniform(0, 6, 3))
    return np.asarray(chirp * [0.25, 0.5, -1.0] + [0.0, 0.4, 0.8])


def positions(target: NDArray[np.float64], late_rows: int = LATE_ROWS) -> NDArray[np.float64]:
    """Return where the joints are before each row and after the last, (rows + 1, 3)."""
    place, speed = target[0].copy(), np.zeros(3)
    places = [place]
    for row in range(len(target)):
        pull = STIFFNESS * (target[max(row - late_rows, 0)] - SAG - place) - DAMPING * speed
        speed = speed + pull / FPS
        place = place + speed / FPS
        places.append(place)
    return np.array(places)


def piece(rows: int, seed: int, *, has_targets: bool = True) -> Piece:
    """Return a piece of the toy joints' motion."""
    target = targets(rows, seed)
    joints = Joints.named(NAMES, has_targets=has_targets)
    given = target if has_targets else np.empty((rows, 0))
    return Piece("toy", positions(target), given, np.zeros(rows, bool), joints)


def write_log(path: Path, rows: int, seed: int) -> Path:
    """Write a log as scripts/pace/data_collection.py of leggedrobotics/pace-sim2real does."""
    target = targets(rows, seed)
    log = {
        "time": torch.linspace(0, rows / FPS, steps=rows),
        "dof_pos": torch.from_numpy(positions(target)[:-1]).float(),
        "des_dof_pos": torch.from_numpy(target).float(),
    }
    torch.save(log, path)
    return path
