"""`astra-data view`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import DatasetName


def view(
    dataset: DatasetName,
    save: Annotated[
        Path | None,
        typer.Option(metavar="FILE.rrd", help="Write a recording.", show_default="open the viewer"),
    ] = None,
    uids: Annotated[
        list[int] | None,
        typer.Option(
            "--episode", metavar="UID", help="Uid of an episode; may be repeated.", show_default="all"
        ),
    ] = None,
) -> None:
    """Show paths, commands and rewards of a dataset in Rerun."""
    from astra_data.dataset.versions import open_dataset
    from astra_data.reports.rerun_view import view as show

    show(open_dataset(dataset), uids or (), save=save)
    if save is not None:
        typer.echo(f"written: {save}")
