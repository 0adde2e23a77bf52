"""`astra-data import`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import Out

Recordings = Annotated[
    list[Path],
    typer.Argument(metavar="SOURCE", help="Files, folders or archives of one format.", show_default=False),
]
MappingFile = Annotated[
    Path | None,
    typer.Option(
        "--mapping",
        help="TOML file that says which fields become which columns. D4RL, robomimic, d3rlpy, Minari and "
        "PACE need none.",
        show_default=False,
    ),
]
FileFormat = Annotated[
    str | None,
    typer.Option(
        "--format",
        help="csv, hdf5, json, mcap, minari, npz, parquet or torch.",
        show_default="inferred from the files' names",
    ),
]
Name = Annotated[str | None, typer.Option(help="Name of the dataset.", show_default="the mapping's")]
Fps = Annotated[int | None, typer.Option(min=1, help="Steps per second.", show_default="the mapping's")]
Task = Annotated[
    str | None, typer.Option(help="What the robot does in the episodes.", show_default="the mapping's")
]
MaxBytes = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Refuse recordings that unpack to more bytes (8 per value).",
        show_default="100 times their size, or 256 MB",
    ),
]
SkipBad = Annotated[
    bool,
    typer.Option(
        "--skip-bad",
        help="Skip files and episodes that cannot be imported and list them at the end.",
    ),
]


def import_(
    recordings: Recordings,
    mapping: MappingFile = None,
    file_format: FileFormat = None,
    out: Out = None,
    name: Name = None,
    fps: Fps = None,
    task: Task = None,
    max_bytes: MaxBytes = None,
    skip_bad: SkipBad = False,
) -> None:
    """Convert logs (CSV, NPZ, HDF5, Parquet, Minari, MCAP, JSON, PyTorch) to a dataset."""
    from astra_data.core.wording import printable
    from astra_data.io.importing import import_dataset

    report = import_dataset(
        recordings,
        mapping,
        out=out,
        file_format=file_format,
        name=name,
        fps=fps,
        task=task,
        max_bytes=max_bytes,
        skip_bad=skip_bad,
    )
    typer.echo("\n".join(map(printable, f"finished: {report}".split("\n"))))
