"""`astra-data view`."""

from pathlib import Path
from typing import Annotated

import typer


def view(
    source: Annotated[
        str,
        typer.Argument(
            metavar="DATASET|RUN",
            help="A dataset: a folder, name@data-1.2.0, or a name (for its highest version); or the folder "
            "of a run, such as runs/cart.",
            show_default=False,
        ),
    ],
    save: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.rrd", help="Write a recording to this file.", show_default="open the viewer"
        ),
    ] = None,
    uids: Annotated[
        list[int] | None,
        typer.Option(
            "--episode",
            metavar="UID",
            help="Uid of an episode; may be repeated.",
            show_default="all; for a run, 5 held-out episodes",
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="For a run: a seed of its recipe.", show_default="the first")
    ] = None,
) -> None:
    """Show a dataset's paths, commands and rewards in Rerun; for a run, also replays in its simulators."""
    from astra_data.core.errors import BadInputError
    from astra_data.core.naming import RECORD
    from astra_data.dataset.format import INFO_PATH
    from astra_data.dataset.versions import locate, open_dataset
    from astra_data.reports.rerun_view import view as show

    folder = Path(source)
    if (folder / RECORD).is_file():
        from astra_data.experiments.run_view import view_run

        if lacking := view_run(folder, uids or (), seed=seed, save=save):
            typer.echo(f"left out: {lacking}")
    else:
        # Beside a folder of that name, as `new` makes one, it may be the name of a dataset.
        if locate(source) == folder and not (folder / INFO_PATH).is_file():
            raise BadInputError(
                f"{source}: expected a dataset (a folder with {INFO_PATH}) or the folder of a run (with "
                f"{RECORD}), got neither: name the folder that import, collect or run wrote"
            )
        if seed is not None:
            raise BadInputError(f"{source} is a dataset, but --seed is for the folder of a run: leave it out")
        show(open_dataset(source), uids or (), save=save)
    if save is not None:
        typer.echo(f"written: {save}")
