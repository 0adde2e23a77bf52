"""Whether policies learned their own simulators, with and without scatter; print Markdown.

    python tools/check_own_worlds.py runs/antmaze_long_fresh --row nas --row nas_plus --seed 223 --seed 224

As in `reached_in_own_world`: mean actions in 100 episodes from the task's starts. A policy that is only late
in a simulator that scatters succeeds in half as much time again, and without the scatter.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import typer
from door import run_tool

from astra_data.core.seeding import derive
from astra_data.experiments.trained_policy import settings_of, trained_policy
from astra_data.grounding.files import grounding_at
from astra_data.grounding.history import HistoryGrounding
from astra_data.methods.follower import FOLLOWER, careful
from astra_data.training.own_world import own_world
from astra_data.training.policy_file import running
from astra_data.training.simulator_episodes import Begin, in_simulator, started
from astra_data.worlds.registry import task_named

EPISODES = 100
MORE_TIME = 1.5


def main(
    run: Path,
    row: Annotated[list[str], typer.Option(help="Rows that are trained in a simulator.")],
    seed: Annotated[list[int], typer.Option(help="Seeds of the run.")],
) -> None:
    """Print two lines for each row: of its policies, and of the careful follower in the same simulators."""
    torch.set_num_threads(1)
    titles = ("simulator of", "who acts", "success", f"in {MORE_TIME} times the time", "without scatter")
    print(f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}")
    for name in row:
        found = [reached(run, name, one) for one in seed]
        for acting in (name, FOLLOWER.name):
            by_test = zip(*(one[acting] for one in found), strict=True)
            told = " | ".join(", ".join(f"{success:.2f}" for success in test) for test in by_test)
            print(f"| {name} | {acting} | {told} |", flush=True)


def reached(run: Path, row: str, seed: int) -> dict[str, list[float]]:
    """Return the success of the row's policy, and of the follower, in the three tests."""
    task = task_named(settings_of(run)["task"])
    made = trained_policy(run, row, seed=seed)
    simulation = made.file.simulation
    assert simulation is not None  # it was trained in a simulator
    grounding = grounding_at(made.files.get("ground"))
    steady = grounding
    if isinstance(grounding, HistoryGrounding):
        steady = replace(grounding, scatter_model=None)
    horizon, drawn = task.objective.horizon, derive(seed, "trial in its own simulator")
    found: dict[str, list[float]] = {row: [], FOLLOWER.name: []}
    for used, steps in ((grounding, horizon), (grounding, round(MORE_TIME * horizon)), (steady, horizon)):
        policy = running(task, made.file, used)
        acting: dict[str, Begin] = {
            row: partial(started, policy, policy.act_in_simulator),
            FOLLOWER.name: partial(careful, task),
        }
        for name, begin in acting.items():
            world = own_world(task, simulation, used, EPISODES)
            outcome, _ = in_simulator(world, begin, steps, drawn)
            found[name].append(fmean(outcome.success))
    return found


if __name__ == "__main__":
    run_tool(main)
