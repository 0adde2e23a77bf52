"""Logs of a toy robot in the form of the NAO's: it follows commands late and too slowly."""

import io
import json
import tarfile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from astra_data.studies.motion import chained, composed
from astra_data.studies.planar_walker import PlanarWalker
from astra_data.studies.recordings import Piece
from astra_data.studies.walking import WALKER

FPS = 60
LATE_ROWS = 20
GAINS = (0.9, 0.6, 0.4)


def actions(rows: int, seed: int, held: int = 30) -> NDArray[np.float64]:
    """Return random actions (rows, 4), each held for `held` rows."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1, 1, (rows // held + 1, 4)), held, axis=0)[:rows]


def states(
    action: NDArray[np.float64], gains: tuple[float, float, float] = GAINS, late_rows: int = LATE_ROWS
) -> NDArray[np.float64]:
    """Return where the toy robot is before each action and after the last, (rows + 1, 5); the ball rests."""
    commands = np.concatenate([np.zeros((late_rows, 4)), action])[: len(action)]
    walker = PlanarWalker(len(commands), timestep_s=1 / FPS)
    walker.reset_to(torch.zeros(len(commands), 8, dtype=torch.float64))
    motion = walker.step(torch.from_numpy(commands))[:, :3] * torch.tensor(gains)
    start = torch.tensor([[0.5, -1.0, 2.0]], dtype=torch.float64)
    path = torch.cat([start, composed(start, chained(motion[None])[0])]).numpy()
    return np.concatenate([path, np.tile([1.0, 1.0], (len(path), 1))], axis=1)


def piece(rows: int, seed: int, **robot: object) -> Piece:
    """Return a piece of the toy robot's walk."""
    action = actions(rows, seed)
    return Piece("toy", states(action, **robot), action, np.zeros(rows, bool), WALKER)  # type: ignore[arg-type]


def log(rows: int, seed: int) -> dict[str, list[list[float]]]:
    """Return a log as the robot writes it: mm, and one action per observation."""
    action = actions(rows, seed)
    observed = states(action)[:-1] * [1000, 1000, 1, 1000, 1000]
    return {"observations": observed.tolist(), "actions": action.tolist()}


def write_archive(path: Path, rows: int, seed: int) -> Path:
    """Write an archive of one log."""
    content = json.dumps(log(rows, seed)).encode()
    with tarfile.open(path, "w:gz") as archive:
        info = tarfile.TarInfo("logs/trajectories_1.log")
        info.size = len(content)
        archive.addfile(info, io.BytesIO(content))
    return path
