"""`astra-data view`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import RunFolder, run_at


def view(
    run: RunFolder,
    save: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help="Write a recording.")] = None,
    uids: Annotated[list[int] | None, typer.Option("--episode", help="Its uid; may be repeated.")] = None,
    seed: Annotated[int | None, typer.Option(help="One of its recipe's.", show_default="the first")] = None,
) -> None:
    """Show a run's held-out episodes in Rerun, and replays of them in its simulators."""
    run_at(run)
    from astra_data.pipeline.run_view import view_run

    view_run(run, uids or (), seed=seed, save=save)
