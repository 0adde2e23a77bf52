"""Measure the noise of a NAO's self-localisation and how late it moves, in its logs. Prints Markdown.

    uv run python tools/nao_noise.py FOLDER

FOLDER holds logs in the form of recipes/imports/nao_guda.toml.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import torch
import typer
from door import run_tool

from astra_data.core.arrays import Floats
from astra_data.studies.planar_walker import walk_command
from astra_data.studies.recordings import Piece, read_recordings
from astra_data.studies.walking import WalkingConfig
from astra_data.worlds.plane.geometry import turned

MAPPING = Path(__file__).parents[1] / "recipes" / "imports" / "nao_guda.toml"
AXES = ("forward (m)", "left (m)", "turn (rad)")
STILL_S = 1.0
STILL_M, STILL_RAD = 0.02, 0.05
"""A robot whose pose a second later is nearer than this counts as standing."""
LATEST_S = 1.0
STEP_S = 0.25
"""Length of a motion that is compared with commands: one step of the robot."""


def main(data: Annotated[Path, typer.Argument(help="Logs of a physical NAO.", show_default=False)]) -> None:
    """Print noise and delays."""
    with TemporaryDirectory() as home:
        recordings = read_recordings(data, MAPPING, Path(home), WalkingConfig())
    print("| recording | axis | pose, standing | motion | delay (s) | correlation there | at 0 s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for recording in recordings:
        parts = [_standing(piece, recording.fps) for piece in recording.pieces]
        still = np.concatenate(parts)
        late = [_followed(recording.pieces, recording.fps, axis) for axis in range(3)]
        for axis, name in enumerate(AXES):
            deviation = float(np.sqrt(np.mean(still[:, axis]))) if len(still) else float("nan")
            delay = int(np.argmax(late[axis]))
            print(
                f"| {recording.name} | {name} | {deviation:.4f} | {deviation * 2**0.5:.4f} | "
                f"{delay / recording.fps:.2f} | {late[axis][delay]:.2f} | {late[axis][0]:.2f} |"
            )
        print(f"| {recording.name} | standing | {len(still) / recording.fps:.0f} s | | | | |")


def _standing(piece: Piece, fps: int) -> Floats:
    """Return the variances of the pose (N, 3), in the body's frame, in the seconds in which it stands."""
    rows = round(STILL_S * fps)
    variances = []
    for first in range(0, len(piece) - rows, rows):
        pose = piece.state[first : first + rows + 1, :3]
        turn = np.unwrap(pose[:, 2])
        moved = np.linalg.norm(pose[-1, :2] - pose[0, :2])
        if (
            moved < STILL_M
            and abs(turn[-1] - turn[0]) < STILL_RAD
            and not piece.broken[first : first + rows].any()
        ):
            place = torch.from_numpy(pose[:, :2] - pose[:, :2].mean(0))
            body = turned(place, torch.full((len(place),), -float(turn.mean()), dtype=place.dtype)).numpy()
            variances += [[*body.var(0), turn.var()]] * rows
    return np.array(variances).reshape(-1, 3)


def _followed(pieces: tuple[Piece, ...], fps: int, axis: int) -> list[float]:
    """Return the correlation of the velocity with the command of 0, 1, 2, ... rows before."""
    rows, latest = round(STEP_S * fps), round(LATEST_S * fps)
    found, asked = [], []
    for piece in pieces:
        pose = torch.from_numpy(piece.state[:, :3])
        moved = turned(pose[rows:, :2] - pose[:-rows, :2], -pose[:-rows, 2]).numpy()
        turn = np.angle(np.exp(1j * (piece.state[rows:, 2] - piece.state[:-rows, 2])))
        motion = np.column_stack([moved, turn])[:, axis]
        command = walk_command(torch.from_numpy(piece.action))[:, axis].numpy()
        command = np.convolve(command, np.ones(rows) / rows, "valid")
        whole = np.convolve(piece.broken, np.ones(rows), "valid") == 0
        keep = np.flatnonzero(whole[latest : len(command)]) + latest
        found.append(motion[keep])
        asked.append(np.stack([command[keep - late] for late in range(latest + 1)], axis=1))
    motion, commands = np.concatenate(found), np.concatenate(asked)
    return [float(np.corrcoef(motion, commands[:, late])[0, 1]) for late in range(latest + 1)]


if __name__ == "__main__":
    run_tool(main)
