"""`astra-data gap`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import RecipePath, Root, Seeds
from astra_data.cli.recipes import Publish, resumable
from astra_data.core.naming import RUNS

Data = Annotated[
    Path,
    typer.Option(
        help="Recordings to predict: a dataset or its name; or a log, an archive or a folder of logs that "
        "the recipe's mapping describes.",
        show_default=False,
    ),
]
Train = Annotated[
    Path | None,
    typer.Option(
        help="Recordings to fit the models to, in the same form.",
        show_default="part of --data; the rest is predicted",
    ),
]


def gap(
    recipe: RecipePath,
    data: Data,
    train: Train = None,
    seeds: Seeds = None,
    publish: Publish = False,
    root: Root = RUNS,
) -> None:
    """Measure how well models predict a real robot's recordings; run it again to continue."""
    from astra_data.studies.run import measure_gap

    with resumable():
        page = measure_gap(recipe, data, train, seeds=seeds or (), publish=publish, root=root)
        typer.echo(f"finished: {page}")
