"""Whose simulators are slow? Run each row's policy, and the careful follower, in each row's simulator.

    python tools/cross_simulators.py runs/behavior_ppo --row nas --row astra --seed 223 --seed 224

Prints Markdown: success, failures and steps to the end of an episode in the simulators that the policies were
trained in, a figure for each seed.
"""

from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Annotated

import typer
from door import run_tool

from astra_data.core.seeding import derive
from astra_data.experiments.trained_policy import settings_of, trained_policy
from astra_data.grounding.files import load_grounding
from astra_data.methods.follower import FOLLOWER, careful
from astra_data.training.episode_record import Outcome
from astra_data.training.own_world import own_world
from astra_data.training.policy_file import running
from astra_data.training.simulator_episodes import Begin, in_simulator, started
from astra_data.worlds.registry import task_named


def main(
    run: Path,
    row: Annotated[list[str], typer.Option(help="Rows that are trained in a grounded simulator.")],
    seed: Annotated[list[int], typer.Option(help="Seeds of the run.")],
    percent: Annotated[int | None, typer.Option(help="Size of the data, of a sweep.")] = None,
    episodes: Annotated[int, typer.Option(help="Of each policy in each simulator.", min=1)] = 40,
) -> None:
    """Print the table."""
    found = [outcomes(run, row, one, percent, episodes) for one in seed]
    print(f"| simulator of | who acts | success | failed | steps |\n|{'---|' * 5}")
    for simulator, acting in found[0]:
        of_seeds = [outcome[simulator, acting] for outcome in found]
        success = ", ".join(f"{fmean(one.success):.2f}" for one in of_seeds)
        failed = ", ".join(f"{fmean(one.failed):.2f}" for one in of_seeds)
        steps = ", ".join(f"{fmean(one.steps):.0f}" for one in of_seeds)
        print(f"| {simulator} | {acting} | {success} | {failed} | {steps} |")


def outcomes(
    run: Path, rows: list[str], seed: int, percent: int | None, episodes: int
) -> dict[tuple[str, str], Outcome]:
    """Return what came of each row's policy and of the follower in each row's simulator, by both names."""
    task = task_named(settings_of(run)["task"])
    made = {row: trained_policy(run, row, seed=seed, percent=percent) for row in rows}
    trained = {row: policy.file for row, policy in made.items()}
    groundings = {row: load_grounding(policy.files["ground"]) for row, policy in made.items()}
    acting: dict[str, Begin] = {FOLLOWER.name: partial(careful, task)}
    for row in rows:
        policy = running(task, trained[row], groundings[row])
        acting[row] = partial(started, policy, policy.act_in_simulator)
    found, drawn = {}, derive(seed, "simulated evaluation")
    for row in rows:
        simulation = trained[row].simulation
        assert simulation is not None  # a row with a grounding is trained in it
        for name, begin in acting.items():
            world = own_world(task, simulation, groundings[row], episodes)
            found[row, name], _ = in_simulator(world, begin, task.objective.horizon, drawn)
    return found


if __name__ == "__main__":
    run_tool(main)
