"""Arguments that several commands take."""

from pathlib import Path
from typing import Annotated

import typer

DatasetName = Annotated[
    str,
    typer.Argument(
        metavar="DATASET", help="A folder, name@data-1.2.0, or name for the newest.", show_default=False
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        help="Folder of the new dataset.", show_default="its place in $ASTRA_DATA_HOME or ./datasets"
    ),
]
