"""Send a physical NAO's recorded commands to simulated ones, and compare how both move. Prints Markdown.

    uv run python tools/replay_nao.py FOLDER

FOLDER holds logs in the form of recipes/imports/nao_guda.toml. Each piece of them is walked by a simulated
robot of its own, from a stand and without control, and compared from 1.9 s on.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import torch
import typer
from door import run_tool
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor

from astra_data.studies.motion import between
from astra_data.studies.planar_walker import PlanarWalker, walk_command
from astra_data.studies.recordings import Piece, read_recordings
from astra_data.studies.walking import WalkingConfig
from astra_data.worlds.nao import BatchedNao
from astra_data.worlds.nao.robot import CONTROL_STEP_S

MAPPING = Path(__file__).parents[1] / "recipes" / "imports" / "nao_guda.toml"
AHEAD = 5
"""Control steps of a motion that is compared: 0.96 s."""
BEGUN = 10
"""Control steps until robots walk."""


def main(
    data: Annotated[Path, typer.Argument(help="Logs of a physical NAO.", show_default=False)],
    seed: Annotated[int, typer.Option(help="Of the simulated robots.")] = 0,
) -> None:
    """Print how far the simulated robots and the abstract simulator are from the physical one."""
    with TemporaryDirectory() as home:
        recordings = read_recordings(data, MAPPING, Path(home), WalkingConfig())
    pieces = [(piece, one.fps * CONTROL_STEP_S) for one in recordings for piece in one.pieces]
    counts = [int(len(piece) / rows) for piece, rows in pieces]
    walked, commanded, fallen = _walked(_actions(pieces, counts), seed)
    motions = []
    for number, (piece, rows) in enumerate(pieces):
        for step in range(BEGUN, counts[number] - AHEAD):
            first, last = round(step * rows), round((step + AHEAD) * rows)
            if not piece.broken[first:last].any() and not fallen[step + AHEAD, number]:
                logged = torch.from_numpy(piece.state[[first, last], :3])
                pairs = (
                    logged,
                    walked[[step, step + AHEAD], number],
                    commanded[[step, step + AHEAD], number],
                )
                motions.append(torch.stack([between(before, after) for before, after in pairs]))
    robot, simulated, raw = torch.stack(motions, dim=1).numpy()
    print("| in 0.96 s | robot, rms | simulated NAO, rms error | moving as commanded | correlations |")
    print("| --- | --- | --- | --- | --- |")
    for axis, name in enumerate(("forward (m)", "sideways (m)", "turn (rad)")):
        errors = [_rms(robot[:, axis])] + [_rms((its - robot)[:, axis]) for its in (simulated, raw)]
        alike = [np.corrcoef(its[:, axis], robot[:, axis])[0, 1] for its in (simulated, raw)]
        shown = " | ".join(f"{error:.3f}" for error in errors)
        print(f"| {name} | {shown} | {alike[0]:.2f}, {alike[1]:.2f} |")
    print(f"\n{len(robot)} moments of {len(pieces)} pieces; {int(fallen[-1].sum())} simulated robots fell.")


def _actions(pieces: list[tuple[Piece, float]], counts: list[int]) -> Tensor:
    """Return the mean action of each control step, (T, B, 4), from pieces and their rows per control step."""
    actions = torch.zeros(max(counts), len(pieces), 4)
    for number, (piece, rows) in enumerate(pieces):
        for step in range(counts[number]):
            mean = piece.action[round(step * rows) : round((step + 1) * rows)].mean(axis=0)
            actions[step, number] = torch.from_numpy(mean)
    return actions


def _walked(actions: Tensor, seed: int) -> tuple[Tensor, Tensor, NDArray[np.bool_]]:
    """Return poses (T + 1, B, 3) of simulated NAOs and abstract simulator, and which fell, (T + 1, B)."""
    robots = actions.shape[1]
    nao, abstract = BatchedNao(robots, seed=seed), PlanarWalker(robots, timestep_s=CONTROL_STEP_S)
    walked, commanded, fallen = [nao.pose], [abstract.state[:, :3]], [nao.fallen.copy()]
    for action in track(actions, description="walking", transient=True):
        nao.step(walk_command(action).double().numpy())
        walked.append(nao.pose)
        commanded.append(abstract.step(action)[:, :3])
        fallen.append(nao.fallen.copy())
    return torch.from_numpy(np.stack(walked)), torch.stack(commanded).double(), np.stack(fallen)


def _rms(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt((errors**2).mean()))


if __name__ == "__main__":
    run_tool(main)
