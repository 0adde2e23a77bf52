"""`astra-data select`."""

from typing import Annotated, Any

import typer

from astra_data.cli.arguments import RunFolder, run_at
from astra_data.core.errors import BadInputError


def select(
    run: RunFolder,
    row: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROW", help="Rank only policies of this row; may be repeated.", show_default="all"
        ),
    ] = None,
    judge: Annotated[
        str | None,
        typer.Option(
            metavar="ROW",
            help="The row whose groundings serve as judges.",
            show_default="nas, else the first that grounds",
        ),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            help="Episodes of each policy with each judge.", min=1, show_default="the recipe's, or 100"
        ),
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(
            help="Make the final choice with this many episodes in the target.", min=1, show_default="none"
        ),
    ] = None,
    field: Annotated[
        int | None,
        typer.Option(
            help="With --trials: number of candidates to try.", show_default="as many as the trials allow"
        ),
    ] = None,
    percent: Annotated[
        int | None,
        typer.Option(
            help="With --trials, after a sweep: the dataset size whose policies are tried.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Rank the trained policies of a run without the target, or with a few trials in it."""
    run_at(run)
    if trials is None and (field is not None or percent is not None):
        raise BadInputError("--field and --percent need --trials: add --trials, or leave them out")
    from astra_data.pipeline.display import shown
    from astra_data.pipeline.selecting import choose_by_trials
    from astra_data.pipeline.selecting import select as rank
    from astra_data.reports.choice import FOLDER

    given: dict[str, Any] = {"rows": row or (), "judge": judge, "episodes": episodes}
    if trials is not None:
        with shown("select") as progress:
            made = choose_by_trials(run, trials, field=field, percent=percent, progress=progress, **given)
        assert made.chosen is not None
        best, seed = made.chosen
        typer.echo(f"chosen with {made.spent} trials: {best}, seed {seed}: success {made.mean:.2f}")
        typer.echo(f"written: {run / FOLDER / 'select.md'}")
        return
    with shown("select") as progress:
        judged = rank(run, progress=progress, **given)
    for percent in judged.percents:
        first = judged.ranked(percent)[0]
        reached = f"{first.lower:.2f} in the lower quartile of its judges"
        size = f" at {percent} %" if percent else ""
        typer.echo(f"chosen{size}: {first.row}, seed {first.seed}: {reached}")
    typer.echo(f"written: {run / FOLDER / 'select.md'}")
