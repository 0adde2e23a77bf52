"""`astra-data sweep`."""

from enum import StrEnum
from typing import Annotated

import typer

from astra_data.cli.arguments import (
    Device,
    Jobs,
    Methods,
    RecipePath,
    Root,
    Seeds,
    Until,
    check_asked,
    recipe_at,
)
from astra_data.cli.recipes import resumable, show_made
from astra_data.core.errors import BadInputError
from astra_data.core.naming import RUNS


class Engine(StrEnum):
    """What runs the items."""

    processes = "processes"
    ray = "ray"


def sweep(
    recipe: RecipePath,
    methods: Methods = None,
    seeds: Seeds = None,
    percents: Annotated[
        list[int] | None,
        typer.Option("--percent", help="Run only this dataset size; may be repeated.", show_default=False),
    ] = None,
    jobs: Jobs = None,
    device: Device = "cpu",
    until: Until = None,
    root: Root = RUNS,
    engine: Annotated[
        Engine, typer.Option(help="Run as processes on this machine, or as tasks of a Ray cluster.")
    ] = Engine.processes,
    address: Annotated[
        str | None,
        typer.Option(
            help="Address of a Ray cluster; its machines must share this folder and installation.",
            show_default="a cluster on this machine",
        ),
    ] = None,
    trackio: Annotated[
        str | None,
        typer.Option(
            metavar="PROJECT", help="Log each finished point to this trackio project.", show_default=False
        ),
    ] = None,
) -> None:
    """Run a recipe over rows, seeds and dataset sizes; run it again to continue."""
    if address is not None and engine is not Engine.ray:
        raise BadInputError("sweep: --address is for --engine ray")
    check_asked(recipe_at(recipe), methods, seeds, percents)
    from astra_data.pipeline.sweep import sweep as sweep_recipe

    with resumable():
        folder = sweep_recipe(
            recipe,
            methods=methods or (),
            seeds=seeds or (),
            percents=percents or (),
            root=root,
            jobs=jobs,
            device=device,
            cluster=(address or "local") if engine is Engine.ray else None,
            trackio=trackio,
            until=until,
        )
        show_made(folder, until, folder / "sweep.csv")
