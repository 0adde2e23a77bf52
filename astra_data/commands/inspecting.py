"""The command that shows what a dataset holds."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.commands.arguments import DatasetName
from astra_data.errors import BadInputError


def inspect(
    dataset: DatasetName,
    plot: Annotated[
        Path | None,
        typer.Option(help="Folder for figures of positions and velocities.", show_default="no figures"),
    ] = None,
) -> None:
    """Show what a dataset holds: its values, its episodes, where the robot was."""
    from rich.console import Console

    from astra_data.dataset.versions import open_dataset
    from astra_data.inspection import inspect_dataset
    from astra_data.inspection_page import inspection_page

    inspection = inspect_dataset(open_dataset(dataset))
    Console(soft_wrap=True).print(inspection_page(inspection))
    if plot is None:
        return
    from astra_data.figures import coverage, png

    drawn = {
        "position_coverage.png": (inspection.positions, "position", "m"),
        "velocity_coverage.png": (inspection.velocities, "velocity", "m/s"),
    }
    found = {name: (planar, *words) for name, (planar, *words) in drawn.items() if planar is not None}
    if not found:
        raise BadInputError(f"{inspection.reference}: the roles of its state tell no position or velocity")
    try:
        plot.mkdir(parents=True, exist_ok=True)
        for name, (planar, label, unit) in found.items():
            (plot / name).write_bytes(png(coverage(planar.counts, planar.extent, label, unit)))
            typer.echo(f"written: {plot / name}")
    except OSError as error:
        raise BadInputError(f"--plot {plot}: expected a folder to write to ({error.strerror})") from None
