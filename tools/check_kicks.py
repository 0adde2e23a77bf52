"""What a run's data tell of kicks, and what its groundings make of them; print Markdown.

    uv run python tools/check_kicks.py runs/nao_kick_fresh --seed 101

A kick begins where it is asked for and was not in the step before, with the ball at rest. Recorded kicks are
replayed in the grounded simulators, and the careful kicker plays there. The target has no say.
"""

from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import typer
from door import run_tool
from torch import Tensor

from astra_data.core.naming import artifact_key
from astra_data.experiments.trained_policy import settings_of
from astra_data.grounding.files import GROUNDING, load_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.moments import Moments
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.networks.paired_windows import PairedWindows
from astra_data.methods.follower import careful
from astra_data.reports.formatting import table
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.training.simulator_episodes import in_simulator
from astra_data.worlds.plane.ball import asks_to_kick
from astra_data.worlds.plane.geometry import wrapped
from astra_data.worlds.registry import task_named
from astra_data.worlds.task import Task

EDGES_M = (0.0, 0.17, 0.20, 0.23, 0.27, 0.35)
"""Of distances from the ball; the simulator's kicks reach as far as the last."""
STEPS = 12
"""After the beginning of a kick, 2.3 s of the NAO, that are looked at."""
AT_REST_M_S, MOVED_M = 0.15, 0.15
REPLAYS, EPISODES = 50, 100


def main(
    run: Annotated[Path, typer.Argument(help="Folder of a run, made until `ground`.")],
    seed: Annotated[int, typer.Option(help="Of the run.")],
    row: Annotated[list[str] | None, typer.Option(help="Rows whose groundings are looked at.")] = None,
) -> None:
    """Print tables of kicks in data and groundings, and of what a careful kicker reaches in the latter."""
    task = task_named(settings_of(run)["task"])
    windows = PairedEpisodes.load(run / artifact_key("pair", "", seed)).windows
    moments, distance = kicks(windows)
    later = moments.after(STEPS)
    way = {"data": windows.state[moments.episode, later, 4:6] - moments.state[:, 4:6]}
    reached = []
    for name in row or ("nas", "astra"):
        made = load_grounding(run / artifact_key("ground", name, seed) / GROUNDING)
        assert isinstance(made, HistoryGrounding)
        way[name] = replayed(task, made, moments)
        simulator = SimulatorEnv(task.objective, made.simulator(task, EPISODES))
        outcome, _ = in_simulator(simulator, partial(careful, task), task.objective.horizon, 0)
        reached.append([name, f"{fmean(outcome.success):.2f}"])
    columns = [f"{what}, {name}" for name in way for what in ("move it", "m", "turn")]
    lines = []
    for low, high in pairwise(EDGES_M):
        there = (distance >= low) & (distance < high)
        ahead = moments.state[there, 4:6] - moments.state[there, :2]
        cells = [cell for ways in way.values() for cell in told(ways[..., there, :], ahead)]
        lines.append([f"{low:.2f} to {high:.2f}", f"{int(there.sum())}", *cells])
    print(table(["distance of the ball in m", "kicks", *columns], lines), "\n")
    print(table(["grounding", "careful kicker"], reached))


def kicks(windows: PairedWindows) -> tuple[Moments, Tensor]:
    """Return where kicks begin, with `STEPS` to come, and how far the ball is (N,), in m."""
    robot, _, ball, rolling = windows.state.split(2, dim=-1)
    asked = asks_to_kick(windows.action.flatten(0, 1)).view(windows.mask.shape)
    begins = torch.zeros_like(asked)
    begins[:, 1:-STEPS] = asked[:, 1:-STEPS] & ~asked[:, : -STEPS - 1] & windows.mask[:, 1 + STEPS :].bool()
    distance = (robot - ball).norm(dim=-1)
    at = begins & (rolling.norm(dim=-1) < AT_REST_M_S) & (distance < EDGES_M[-1])
    return Moments(windows, *at.nonzero(as_tuple=True)), distance[at]


@torch.no_grad()
def replayed(task: Task, made: HistoryGrounding, moments: Moments) -> Tensor:
    """Return the way of the ball in `STEPS` simulated ones, (REPLAYS, N, 2), in m."""
    hidden = made.hidden_before(moments.windows)[moments.episode, moments.first]
    simulator = made.corrected(task.simulator(len(moments)), None)
    ways = []
    for _ in range(REPLAYS):
        moments.start(simulator, hidden)
        for count in range(STEPS):
            state = simulator.step(moments.action(count))
        ways.append(state[:, 4:6] - moments.state[:, 4:6])
    return torch.stack(ways)


def told(way: Tensor, ahead: Tensor) -> tuple[str, str, str]:
    """Tell which share of kicks moves the ball, how far those do, and how much their ways scatter.

    Args:
        way: of balls, (..., N, 2) in m.
        ahead: from robots to their balls, (N, 2), which the ways are compared with.

    Returns:
        the share; their mean in m; the root mean square of the angles between way and `ahead`, in degrees.
    """
    moved = way.norm(dim=-1) > MOVED_M
    turn = wrapped(torch.atan2(way[..., 1], way[..., 0]) - torch.atan2(ahead[:, 1], ahead[:, 0]))
    share = f"{moved.float().mean():.2f}" if moved.numel() else "-"
    if not moved.any():
        return share, "-", "-"
    far, turned = way.norm(dim=-1)[moved].mean(), turn[moved].square().mean().sqrt().rad2deg()
    return share, f"{far:.2f}", f"{turned:.0f}°"


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.manual_seed(0)
    run_tool(main)
