"""`astra-data select`."""

from pathlib import Path
from typing import Annotated

import typer


def select(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="The folder of a run, runs/cart.", show_default=False)
    ],
    row: Annotated[
        list[str] | None, typer.Option(help="Only policies of this row; may be repeated.", show_default="all")
    ] = None,
    judge: Annotated[
        str | None, typer.Option(help="The row whose groundings judge.", show_default="the reference")
    ] = None,
    episodes: Annotated[int, typer.Option(help="Of each policy with each judge.", min=1)] = 100,
) -> None:
    """Rank the trained policies of a run without the target, in simulators of other episodes."""
    from astra_data.experiments.display import shown
    from astra_data.experiments.selecting import FOLDER
    from astra_data.experiments.selecting import select as rank

    with shown("select") as progress:
        ranked = rank(run, rows=row or (), judge=judge, episodes=episodes, progress=progress)
    first = ranked[0]
    reached = f"{first.lower:.2f} in the lower quartile of its judges"
    typer.echo(f"chosen: {first.row}, seed {first.seed}: {reached}")
    typer.echo(f"written: {run / FOLDER / 'select.md'}")
