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
    episodes: Annotated[
        int | None,
        typer.Option(help="Of each policy with each judge.", min=1, show_default="the recipe's, or 100"),
    ] = None,
) -> None:
    """Rank the trained policies of a run without the target, in simulators of other episodes."""
    from astra_data.experiments.display import shown
    from astra_data.experiments.selecting import select as rank

    with shown("select") as progress:
        judged = rank(run, rows=row or (), judge=judge, episodes=episodes, progress=progress)
    for percent in judged.percents:
        first = judged.ranked(percent)[0]
        reached = f"{first.lower:.2f} in the lower quartile of its judges"
        size = f" at {percent} %" if percent else ""
        typer.echo(f"chosen{size}: {first.row}, seed {first.seed}: {reached}")
    typer.echo(f"written: {run / 'select' / 'select.md'}")
