"""Does z hold what φ(s) lacks, and does the policy use it? Print Markdown.

    python tools/probe_latents.py runs/antmaze_long --row nas --row astra --seed 0
    python tools/probe_latents.py runs/antmaze_long --row nas --policies target --episodes 100

The first table has R² on held-out episodes of linear probes from φ(s), from φ(s) with the actions of the last
steps, and from each row's z, to each entry of the target state that φ drops, and to where the way to the goal
leads. The second has the success of
each row's policy with its own latents, with those of other robots, drawn anew at every step, and with zeros.
"""

from enum import StrEnum
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import typer
from altered_latents import ALTERATIONS, AlteredLatents, in_target
from door import run_tool
from probes import Probed, dropped_values, picking_split, probe, recent_actions, way_to_goal
from torch import Tensor

from astra_data.core.naming import artifact_key
from astra_data.core.seeding import derive
from astra_data.experiments.trained_policy import settings_of, trained_policy
from astra_data.grounding.files import GROUNDING, load_grounding, load_history_model
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods import grounded_as
from astra_data.training.own_world import own_world
from astra_data.training.simulator_episodes import in_simulator, started
from astra_data.worlds.plane.navigation import Navigation
from astra_data.worlds.registry import task_named


class Where(StrEnum):
    """Where policies are run."""

    NOWHERE = "nowhere"
    TARGET = "target"
    SIMULATOR = "simulator"


def main(
    run: Path,
    row: Annotated[list[str], typer.Option(help="Rows whose latents are probed.")],
    seed: Annotated[int, typer.Option(help="Of the run.")] = 0,
    steps: Annotated[int, typer.Option(help="Actions beside φ(s), for comparison.")] = 20,
    policies: Annotated[Where, typer.Option(help="Where to run the rows' policies.")] = Where.NOWHERE,
    episodes: Annotated[int, typer.Option(help="Of each policy.")] = 100,
) -> None:
    """Print the tables of probes and of policies."""
    _probes(run, row, seed, steps)
    if policies is not Where.NOWHERE:
        print(f"\n| success in the {policies} with latents | {' | '.join(ALTERATIONS)} |")
        print("|---|" + "---|" * len(ALTERATIONS))
        for name in row:
            reached = successes(run, name, seed, policies, episodes)
            print(f"| {name} | " + " | ".join(f"{reached[kind]:.2f}" for kind in ALTERATIONS) + " |")


@torch.no_grad()
def _probes(run: Path, rows: list[str], seed: int, steps: int) -> None:
    settings = settings_of(run)
    task = task_named(settings["task"])
    paired = PairedEpisodes.load(run / artifact_key("pair", "", seed))
    training, held_out = paired.split(settings["ground"]["held_out_share"], seed)
    parts = (*picking_split(training, seed), held_out)
    values = [dropped_values(task.state, part) for part in parts]
    if isinstance(task.objective, Navigation):
        values = [
            known | way_to_goal(task.objective, part) for known, part in zip(values, parts, strict=True)
        ]
    inputs: dict[str, list[Tensor]] = {
        "φ(s)": [part.windows.state for part in parts],
        f"φ(s) and {steps} actions": [recent_actions(part, steps) for part in parts],
    }
    for name in rows:
        file = run / artifact_key("ground", grounded_as(name), seed) / GROUNDING
        model = load_history_model(file)
        inputs[f"z of {name}"] = [model.encode(part.windows)[0] for part in parts]
    found = {name: probe(*map(Probed.of, parts, given, values)) for name, given in inputs.items()}
    print("| R² of | " + " | ".join(found) + " |\n|---|" + "---|" * len(found))
    for index, quantity in enumerate(values[0]):
        print(f"| {quantity} | " + " | ".join(f"{r2[index]:.2f}" for r2 in found.values()) + " |")
    print("| mean | " + " | ".join(f"{r2.nanmean():.2f}" for r2 in found.values()) + " |")


def successes(run: Path, row: str, seed: int, where: Where, episodes: int) -> dict[str, float]:
    """Return the success of a row's policy by what its latents are altered to."""
    made = trained_policy(run, row, seed=seed)
    deployed = made.running()
    reached = {}
    for kind, alter in ALTERATIONS.items():
        altered = AlteredLatents.of(deployed, alter)
        if where is Where.TARGET:
            outcome = in_target(altered, episodes, derive(seed, "evaluation"))
        else:
            trained, grounding = made.file, load_grounding(made.files["ground"])
            if trained.simulation is None:
                raise typer.BadParameter(f"{row} was not trained in a simulator")
            world = own_world(deployed.task, trained.simulation, grounding, episodes)
            begin = partial(started, altered, altered.act_in_simulator)
            horizon = deployed.task.objective.horizon
            outcome, _ = in_simulator(world, begin, horizon, derive(seed, "simulated evaluation"))
        reached[kind] = fmean(outcome.success)
    return reached


if __name__ == "__main__":
    run_tool(main)
