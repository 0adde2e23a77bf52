"""`astra-data deploy`."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import RunFolder, run_at
from astra_data.core.naming import RECORD, artifact_key


def deploy(
    run: RunFolder,
    row: Annotated[
        str,
        typer.Option(
            metavar="ROW", help="A row of the run's recipe, such as astra_plus.", show_default=False
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="The new folder.", show_default="RUN/deploy/ROW/seed_SEED")
    ] = None,
    seed: Annotated[int, typer.Option(help="A seed of the run's recipe.")] = 0,
    percent: Annotated[
        int | None,
        typer.Option(help="The dataset size in percent, if the recipe has several.", show_default=False),
    ] = None,
) -> None:
    """Export a trained policy as a folder that runs without this package."""
    from astra_data.core.durable import refuse_existing
    from astra_data.pipeline.points import refuse_unmade

    run_at(run)
    out = out or run / artifact_key("deploy", row, seed, percent)
    refuse_existing(out)
    if not (run / artifact_key("train", row, seed, percent)).is_dir():
        with suppress(ValueError, TypeError, AttributeError):  # a damaged record is told of below
            refuse_unmade(json.loads((run / RECORD).read_bytes()), row, seed)
    from astra_data.deployment.folder import deploy as write

    typer.echo(f"finished: {write(run, row, out, seed=seed, percent=percent)}")
