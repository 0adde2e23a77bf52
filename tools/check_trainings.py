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
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
import typer
from door import run_tool

from astra_data.core.config import validated
from astra_data.core.errors import BadInputError
from astra_data.core.naming import is_plus
from astra_data.core.progress import silent
from astra_data.core.seeding import derive
from astra_data.experiments.plan import plan
from astra_data.experiments.recipe import Recipe
from astra_data.experiments.trained_policy import settings_of
from astra_data.grounding.files import load_grounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding
from astra_data.grounding.raw import NO_GROUNDING
from astra_data.methods import method_named
from astra_data.training.own_world import reached_in_own_world
from astra_data.training.train import Training
from astra_data.worlds.registry import task_named


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
    recorded, table = settings_of(run), "plus" if is_plus(row) else "train"
    changed = recorded | {"methods": [row], "seeds": [seed], table: recorded.get(table, {}) | changes}
    changed.pop("select", None)  # one row of one seed leaves nothing to choose from
    items = plan(validated(changed, Recipe, f"{run}"), Path(f"{run}.toml"), run)
    call: Any = next(item.call for item in items if item.key == f"train/{row}/seed_{seed}")
    given, learn = call.keywords, method_named(row).learn
    if learn is None:
        raise BadInputError(f"{row} trains nothing: expected a row that is trained in a simulator")
    grounding: Grounding = NO_GROUNDING
    if given["grounding"]:
        grounding = load_grounding(given["grounding"] / "grounding.safetensors")
    with tempfile.TemporaryDirectory() as folder:
        training = Training(
            task=task_named(given["task"]),
            config=given["config"],
            settings=given["settings"],
            episodes=PairedEpisodes.load(given["dataset"]),
            grounding=grounding,
            initial=None,
            seed=derive(seed, f"policy {policy}") if policy else seed,
            device="cpu",
            folder=Path(folder),
            progress=silent,
        )
        began = time.process_time()
        made, _ = learn(training)
        seconds = time.process_time() - began
    reached = reached_in_own_world(training.task, made, grounding, seed)
    return Trained(reached.success, reached.steps, seconds)


if __name__ == "__main__":
    run_tool(main)
