"""The command line. Commands import what they need when they run, so that `astra-data --help` is fast."""

import logging
import os
import sys
from collections.abc import Callable
from importlib.metadata import version
from typing import Annotated

import typer

from astra_data.cli import (
    augmenting,
    building,
    checking,
    comparing,
    deploying,
    editing,
    exporting,
    importing,
    inspecting,
    predicting,
    recipes,
    selecting,
    sharing,
    shipping,
    starting,
    sweeping,
    tasks,
    viewing,
)
from astra_data.core.disk import disk_error
from astra_data.core.durable import NO_FSYNC
from astra_data.core.errors import AstraDataError
from astra_data.core.optional import missing_extra
from astra_data.core.wording import in_lines

app = typer.Typer(
    help="Turn robot logs into datasets, and datasets into policies trained in a simplified simulator.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


class _InLines(logging.Formatter):
    """Warnings whose names control no terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the message."""
        return in_lines(super().format(record))


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"astra-data {version('astra-data')}")
        raise typer.Exit


@app.callback()
def _options(
    show_version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
    no_fsync: Annotated[
        bool,
        typer.Option(
            "--no-fsync",
            help="Do not wait for the disk: faster, but a power failure may lose what was written.",
        ),
    ] = False,
) -> None:
    """Options before any command."""
    if logging.lastResort is not None:  # what prints warnings
        logging.lastResort.setFormatter(_InLines())
    if no_fsync:
        os.environ[NO_FSYNC] = "1"


PANELS: dict[str, dict[str, Callable[..., None]]] = {
    "Recipes": {
        "new": starting.new,
        "run": recipes.run,
        "sweep": sweeping.sweep,
        "check": recipes.check,
        "ground": recipes.ground,
        "train": recipes.train,
        "align": recipes.align,
        "evaluate": recipes.evaluate,
        "report": recipes.report,
        "select": selecting.select,
        "deploy": deploying.deploy,
        "gap": predicting.gap,
        "tasks": tasks.tasks,
    },
    "Recipes or datasets": {
        "collect": building.collect,
        "pair": building.pair,
        "subset": editing.subset,
    },
    "Datasets": {
        "label": tasks.label,
        "augment": augmenting.augment,
        "merge": editing.merge,
        "delete": editing.delete,
        "filter": editing.filter_,
        "list": inspecting.list_,
        "inspect": inspecting.inspect,
        "view": viewing.view,
        "validate": checking.validate,
        "repair": checking.repair,
        "log": comparing.log,
        "diff": comparing.diff,
    },
    "Exchange": {
        "import": importing.import_,
        "export": exporting.export,
        "card": sharing.card,
        "push": sharing.push,
        "pull": sharing.pull,
    },
}
for panel, commands in PANELS.items():
    for name, command in commands.items():
        app.command(name, rich_help_panel=panel)(command)
app.add_typer(
    shipping.app,
    name="recipes",
    help="List or copy the package's recipes and mappings.",
    rich_help_panel="Recipes",
)


def main() -> None:
    """Run the command line; print what is expected to happen as one line unless ASTRA_DATA_DEBUG is set."""
    try:
        app()
    except Exception as error:
        reported = _reported(error)
        if reported is None or os.environ.get("ASTRA_DATA_DEBUG"):
            raise
        typer.echo(f"error: {in_lines(str(reported))}", err=True)
        sys.exit(1)


def _reported(error: Exception) -> AstraDataError | None:
    """Return what to print of `error`; None if it is a fault of the program."""
    if isinstance(error, ModuleNotFoundError):
        return missing_extra(error)
    return error if isinstance(error, AstraDataError) else disk_error(error)


if __name__ == "__main__":
    main()
