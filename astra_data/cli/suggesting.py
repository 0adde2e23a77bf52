"""`astra-data suggest`."""

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from astra_data.cli.recipes import Root
from astra_data.core.naming import RUNS


def suggest(
    run: Annotated[
        Path,
        typer.Argument(metavar="RUN|RECIPE", help="The folder of a run, or its recipe.", show_default=False),
    ],
    episodes: Annotated[int, typer.Option(help="Number of episodes to suggest.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Random seed of the episodes to choose from.")] = 0,
    row: Annotated[
        str | None, typer.Option(help="The row whose groundings are used.", show_default="the reference")
    ] = None,
    max_steps: Annotated[
        int | None, typer.Option(help="Length of each episode, in steps.", min=1, show_default="the recipe's")
    ] = None,
    proposals: Annotated[int, typer.Option(help="Number of random episodes to choose from.", min=2)] = 2000,
    out: Annotated[
        Path | None, typer.Option(help="A new folder.", show_default="suggest in the run's folder")
    ] = None,
    root: Root = RUNS,
) -> None:
    """Say which episodes to record next: those where the corrections of a run's groundings disagree."""
    import torch

    from astra_data.experiments.display import shown
    from astra_data.experiments.suggesting import suggest as write
    from astra_data.worlds.registry import task_named

    given: dict[str, Any] = {"episodes": episodes, "proposals": proposals}
    given |= {} if max_steps is None else {"max_steps": max_steps}
    torch.set_num_threads(1)
    with shown("suggest") as progress:
        folder, found, task = write(run, row=row, seed=seed, out=out, root=root, progress=progress, **given)
    expected = found.rollouts.expected.sum(0)
    nats, average = expected[found.taken].mean(), expected.mean()
    number = f"{len(found.taken)} of {len(expected)}"
    typer.echo(
        f"suggested: {number} episodes, {nats:.1f} nats each on average (all proposals: {average:.1f})"
    )
    typer.echo(f"written: {folder / 'suggest.md'}, {folder / 'plan.json'}, {folder / 'map.png'}")
    if task_named(task).has_target:
        plan = shlex.quote(str(folder / "plan.json"))
        typer.echo(f"record them: astra-data collect {shlex.quote(task)} --plan {plan} --name more")
