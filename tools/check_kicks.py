"""What a run's data tell of kicks, and what its groundings make of them; print Markdown.

    uv run python tools/check_kicks.py runs/nao_kick_fresh --seed 101

A kick begins where it is asked for and was not in the step before, with the ball at rest. The target has no
say: data, groundings and the careful kicker in their simulators are looked at.
"""

from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import typer
from torch import Tensor

from astra_data.core.naming import place
from astra_data.experiments.trained_policy import settings_of
from astra_data.grounding.files import GROUNDING, load_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.networks.paired_windows import PairedWindows
from astra_data.methods.follower import careful
from astra_data.reports.formatting import table
from astra_data.training.own_world import in_simulator
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.worlds.plane.ball import asks_to_kick
from astra_data.worlds.registry import task_named
from astra_data.worlds.task import Task

EDGES_M = (0.0, 0.17, 0.20, 0.23, 0.27, 0.35)
STEPS = 8
"""After the beginning of a kick, 1.5 s of the NAO, that are looked at."""
AT_REST_M_S, MOVED_M = 0.15, 0.15
EPISODES = 100


def main(
    run: Annotated[Path, typer.Argument(help="Folder of a run, made until `ground`.")],
    seed: Annotated[int, typer.Option(help="Of the run.")],
    row: Annotated[list[str] | None, typer.Option(help="Rows whose groundings are looked at.")] = None,
) -> None:
    """Print a table of the data, one of the groundings, and what a careful kicker reaches in these."""
    task = task_named(settings_of(run)["task"])
    windows = PairedEpisodes.load(run / "pair" / place(seed)).windows
    begins, distance = kicks(windows)
    ball = windows.state[..., 4:6]
    moved = (ball[:, STEPS:] - ball[:, :-STEPS]).norm(dim=-1) > MOVED_M
    lines = []
    for low, high in pairwise(EDGES_M):
        there = begins & (distance >= low) & (distance < high)
        share = moved[there[:, :-STEPS]]
        lines.append([f"{low:.2f} to {high:.2f}", f"{len(share)}", f"{int(share.sum())}"])
    print(table(["distance of the ball in m", "kicks", "of them that move it"], lines), "\n")
    lines = [grounded(task, run / "ground" / name / place(seed), windows) for name in row or ("nas", "astra")]
    print(table(["grounding", "a kicked ball moves, m a step", "predicted", "careful kicker"], lines))


def kicks(windows: PairedWindows) -> tuple[Tensor, Tensor]:
    """Return where kicks begin (E, T), bool, with `STEPS` to come, and how far the ball is (E, T), in m."""
    robot, _, ball, rolling = windows.state.split(2, dim=-1)
    asked = asks_to_kick(windows.action.flatten(0, 1)).view(windows.mask.shape)
    begins = torch.zeros_like(asked)
    begins[:, 1:-STEPS] = asked[:, 1:-STEPS] & ~asked[:, : -STEPS - 1] & windows.mask[:, 1 + STEPS :].bool()
    return begins & (rolling.norm(dim=-1) < AT_REST_M_S), (robot - ball).norm(dim=-1)


@torch.no_grad()
def grounded(task: Task, folder: Path, windows: PairedWindows) -> list[str]:
    """Return a line of the second table."""
    made = load_grounding(folder / GROUNDING)
    assert isinstance(made, HistoryGrounding)
    model = made.model
    latent, _ = model.encoder(model.encoder_input(windows.state, windows.goal, windows.previous_action))
    predicted = model.ensemble_predictions(latent, windows.action, windows.simulated_next).mean(0)
    begins, distance = kicks(windows)
    episode, step = (begins & (distance < EDGES_M[3])).nonzero().T
    after = step + torch.arange(1, STEPS).unsqueeze(1)
    true, told = (
        (following[episode, after, 4:6] - windows.state[episode, after, 4:6]).norm(dim=-1).mean()
        for following in (windows.next_state, predicted)
    )
    simulator = SimulatorEnv(task.objective, made.simulator(task, EPISODES))
    outcome, _ = in_simulator(simulator, partial(careful, task), task.objective.horizon, 0)
    return [folder.parent.name, f"{true:.3f}", f"{told:.3f}", f"{fmean(outcome.success):.2f}"]


if __name__ == "__main__":
    torch.set_num_threads(1)
    typer.run(main)
