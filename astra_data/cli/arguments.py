"""Arguments of several commands."""

from pathlib import Path
from typing import Annotated

import typer

DatasetName = Annotated[
    str,
    typer.Argument(
        metavar="DATASET",
        help="A folder, name@data-1.2.0, or a name (for its highest version).",
        show_default=False,
    ),
]
Source = Annotated[
    str,
    typer.Argument(
        metavar="RECIPE|DATASET",
        help="A recipe (.toml), or a dataset: a folder, name@data-1.2.0, or a name (for its highest "
        "version). The settings below apply to a dataset only; a recipe has its own.",
        show_default=False,
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        help="Folder of the new dataset.", show_default="its place in $ASTRA_DATA_HOME or ./datasets"
    ),
]

NewName = Annotated[
    str | None,
    typer.Option(
        "--name",
        help="Name of the new dataset, which starts at version 1.0.0; where there are datasets of that name, "
        "it is their next version.",
        show_default="a new version",
    ),
]
