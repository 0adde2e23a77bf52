"""Train rows of a run again from several policy seeds, test them in their own simulators, print Markdown.

    uv run python tools/check_trainings.py runs/antmaze_long --row nas --row astra --policies 10
    uv run python tools/check_trainings.py runs/antmaze_long --row nas --set critic_gain=0.01

Data and groundings are those of one seed of the run, which has to be made up to `ground`; the target has no
say. Success is that of the mean actions in 100 episodes from the task's starts, without noise of training.
"""

import json
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
import typer
from door import run_tool

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.methods import method_named
from astra_data.pipeline.grounded_env import training_of
from astra_data.policies.episodes import reached_in_own_world


class Trained(NamedTuple):
    """What a policy reached in its own simulator, in how many steps, and the time of its training."""

    success: float
    steps: float
    cpu_seconds: float


def main(
    run: Path,
    row: Annotated[list[str], typer.Option(help="Rows to train.")],
    seed: Annotated[int, typer.Option(help="Of the run: of its data and groundings.")] = 0,
    policies: Annotated[int, typer.Option(help="Trainings of each row.")] = 5,
    jobs: Annotated[int, typer.Option(help="Trainings at a time, on one core each.")] = 1,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Of [train] or [plus], as key=value.")
    ] = None,
) -> None:
    """Print a line for each row."""
    changes = dict(map(_setting, settings or []))
    print("| row | success by policy | steps | processor time |\n|---|---|---|---|")
    for name in row:
        train = partial(trained, run, name, seed, changes)
        with ProcessPoolExecutor(jobs) as pool:
            found = list(pool.map(train, range(policies)))
        success, steps, seconds = zip(*found, strict=True)
        shown = (
            ", ".join(f"{value:.2f}" for value in success),
            ", ".join(f"{value:.0f}" for value in steps),
            f"{sum(seconds) / len(seconds):.0f} s",
        )
        print(f"| {name} | {' | '.join(shown)} |", flush=True)


def _setting(told: str) -> tuple[str, Any]:
    name, _, value = told.partition("=")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        raise BadInputError(f"--set: expected key=value, the value as in JSON, got {told!r}") from None


def trained(run: Path, row: str, seed: int, changes: dict[str, Any], policy: int) -> Trained:
    """Train a row of the run from the policy seed number `policy`; the first is the run's own."""
    torch.set_num_threads(1)
    training = training_of(run, row, seed, changes=changes)
    learn = method_named(row).learn
    assert learn is not None
    if policy:
        training = replace(training, seed=derive(seed, f"policy {policy}"))
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        made, _ = learn(replace(training, folder=Path(folder)))
        seconds = time.process_time() - began
    reached = reached_in_own_world(training.task, made, training.grounding, seed)
    return Trained(reached.success, reached.steps, seconds)


if __name__ == "__main__":
    run_tool(main)
