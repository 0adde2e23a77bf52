"""`astra-data inspect` and `astra-data list`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import DatasetName
from astra_data.core.errors import BadInputError


def inspect(
    dataset: DatasetName,
    plot: Annotated[
        Path | None,
        typer.Option(help="Folder for figures of positions and velocities.", show_default="no figures"),
    ] = None,
) -> None:
    """Show the contents of a dataset: its values, its episodes, where the robot was."""
    from rich.console import Console

    from astra_data.cli.inspection_page import inspection_page
    from astra_data.dataset.inspection import inspect_dataset
    from astra_data.dataset.versions import open_dataset

    inspection = inspect_dataset(open_dataset(dataset))
    Console(soft_wrap=True).print(inspection_page(inspection))
    if plot is None:
        return
    from astra_data.reports.figures import coverage, png

    maps = ((inspection.positions, "position", "m"), (inspection.velocities, "velocity", "m/s"))
    found = [(planar, label, unit) for planar, label, unit in maps if planar is not None]
    if not found:
        raise BadInputError(
            f"{inspection.reference}: its state has no column with the role position or velocity"
        )
    try:
        plot.mkdir(parents=True, exist_ok=True)
        for planar, label, unit in found:
            path = plot / f"{label}_coverage.png"
            path.write_bytes(png(coverage(planar.counts, planar.extent, label, unit)))
            typer.echo(f"written: {path}")
    except OSError as error:
        raise BadInputError(f"--plot {plot}: expected a folder to write to ({error.strerror})") from None


def list_() -> None:
    """List the datasets at home and their versions."""
    from rich.console import Console
    from rich.table import Table

    from astra_data.dataset.versions import home, names_at_home, open_dataset, versions_at_home

    table = Table("dataset", "stage", "episodes", "steps", "content", title=str(home()))
    for name in names_at_home():
        for version in versions_at_home(name):
            found = open_dataset(f"{name}@data-{version}")
            steps = int(found.lengths.sum())
            facts = (found.description["stage"], f"{len(found):,}", f"{steps:,}", found.content_hash[:12])
            table.add_row(found.reference, *facts)
    Console().print(table)
