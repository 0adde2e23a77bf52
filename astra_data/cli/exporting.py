"""`astra-data export`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import DatasetName


def export(
    dataset: DatasetName,
    format: Annotated[str, typer.Option(help="minari, d4rl, robomimic or d3rlpy.", show_default=False)],
    out: Annotated[
        Path,
        typer.Option(help="The new file; for minari a folder, such as maze/random-v0.", show_default=False),
    ],
) -> None:
    """Convert a dataset to the format of another library."""
    from astra_data.dataset.versions import open_dataset
    from astra_data.io.exporters import export as write

    write(open_dataset(dataset), out, format=format)
    typer.echo(f"finished: {out}")
