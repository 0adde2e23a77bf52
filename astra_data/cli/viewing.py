"""`astra-data view`."""

from pathlib import Path
from typing import Annotated

import typer


def view(
    source: Annotated[
        str,
        typer.Argument(
            metavar="DATASET|RUN",
            help="A dataset: a folder, name@data-1.2.0, or name for its highest version; or the folder of a "
            "run, runs/cart.",
            show_default=False,
        ),
    ],
    save: Annotated[
        Path | None,
        typer.Option(metavar="FILE.rrd", help="Write a recording.", show_default="open the viewer"),
    ] = None,
    uids: Annotated[
        list[int] | None,
        typer.Option(
            "--episode",
            metavar="UID",
            help="Uid of an episode; may be repeated.",
            show_default="all; of a run 5 that were held out",
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Of a run: a seed of its recipe.", show_default="the first")
    ] = None,
) -> None:
    """Show paths, commands and rewards of a dataset in Rerun; of a run, also its simulators."""
    from astra_data.core.errors import BadInputError
    from astra_data.core.naming import RECORD
    from astra_data.dataset.format import INFO_PATH
    from astra_data.dataset.versions import open_dataset
    from astra_data.reports.rerun_view import view as show

    folder = Path(source)
    if (folder / RECORD).is_file():
        from astra_data.experiments.run_view import view_run

        if lacking := view_run(folder, uids or (), seed=seed, save=save):
            typer.echo(f"left out: {lacking}")
    else:
        if folder.is_dir() and not (folder / INFO_PATH).is_file():
            raise BadInputError(
                f"{source}: expected a dataset, which holds {INFO_PATH}, or the folder of a run, which holds "
                f"{RECORD}; got neither: name the folder that import, collect or run wrote"
            )
        if seed is not None:
            raise BadInputError(f"{source} is a dataset: --seed is for the folder of a run")
        show(open_dataset(source), uids or (), save=save)
    if save is not None:
        typer.echo(f"written: {save}")
