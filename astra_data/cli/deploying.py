"""`astra-data deploy`."""

from pathlib import Path
from typing import Annotated

import typer


def deploy(
    run: Annotated[
        Path,
        typer.Argument(metavar="RUN", help="The folder of a run, such as runs/cart.", show_default=False),
    ],
    row: Annotated[
        str, typer.Option(help="A row of the run's recipe, such as astra_plus.", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="The new folder.", show_default=False)],
    seed: Annotated[int, typer.Option(help="A seed of the run's recipe.")] = 0,
    percent: Annotated[
        int | None,
        typer.Option(help="The dataset size in percent, if the recipe has several.", show_default=False),
    ] = None,
) -> None:
    """Export a trained policy as a folder that runs without this package."""
    from astra_data.deployment.folder import deploy as write

    typer.echo(f"finished: {write(run, row, out, seed=seed, percent=percent)}")
