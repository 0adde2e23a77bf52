"""The command line. Commands import what they need when they run, so that `astra-data --help` is fast."""

import logging
import os
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import typer
from typer.core import TyperArgument
from typer.models import OptionInfo

from astra_data.cli import building, datasets, recipes, sharing, starting
from astra_data.core.durable import NO_FSYNC, disk_error
from astra_data.core.errors import AstraDataError
from astra_data.core.naming import in_lines
from astra_data.core.optional import missing_extra

app = typer.Typer(
    help="Turn robot logs into datasets, and datasets into policies trained in a simplified simulator.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
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
        "check": recipes.check,
        "ground": recipes.ground,
        "train": recipes.train,
        "align": recipes.align,
        "evaluate": recipes.evaluate,
        "report": recipes.report,
        "select": recipes.select,
        "deploy": recipes.deploy,
        "view": recipes.view,
    },
    "Recipes or datasets": {
        "collect": building.collect,
        "pair": building.pair,
        "subset": datasets.subset,
    },
    "Datasets": {
        "label": building.label,
        "augment": building.augment,
        "merge": datasets.merge,
        "filter": datasets.filter_,
        "list": datasets.list_,
        "inspect": datasets.inspect,
        "validate": datasets.validate,
        "repair": datasets.repair,
        "log": datasets.log,
    },
    "Exchange": {
        "import": sharing.import_,
        "export": sharing.export,
        "push": sharing.push,
        "pull": sharing.pull,
    },
}
EXAMPLES = {
    "new": "astra-data new robot --from logs/*.csv",
    "run": "astra-data run recipes/quickstart.toml --until ground",
    "check": "astra-data check recipes/quickstart.toml cart.py:TASK",
    "ground": "astra-data ground recipes/quickstart.toml --method astra",
    "train": "astra-data train recipes/quickstart.toml --method astra_plus --device cuda",
    "align": "astra-data align recipes/quickstart.toml",
    "evaluate": "astra-data evaluate recipes/quickstart.toml --seed 0",
    "report": "astra-data report recipes/quickstart.toml",
    "select": "astra-data select runs/cart --row astra --trials 40",
    "deploy": "astra-data deploy runs/quickstart --row astra",
    "collect": "astra-data collect antmaze-umaze --episodes 50 --name walks",
    "pair": "astra-data pair walks --simulator antmaze-umaze",
    "subset": "astra-data subset walks --percent 50 --name half",
    "label": "astra-data label logs --task cart.py:TASK",
    "augment": "astra-data augment walks --copies 3 --rotations quarter",
    "merge": "astra-data merge walks more --name all",
    "filter": "astra-data filter walks --success",
    "list": "astra-data list",
    "inspect": "astra-data inspect walks --plot figures",
    "view": "astra-data view runs/quickstart --save run.rrd",
    "validate": "astra-data validate walks@data-1.0.0",
    "repair": "astra-data repair broken --out repaired",
    "log": "astra-data log walks",
    "import": "astra-data import logs/*.csv --mapping logs.toml",
    "export": "astra-data export walks --format d4rl --out walks.hdf5",
    "push": "astra-data push walks me/walks",
    "pull": "astra-data pull me/walks",
}
"""What to type for each command, below its help."""
_NAMES = {int: "NUMBER", float: "NUMBER", str: "TEXT", Path: "PATH", bool: ""}
"""How help names values of these types."""


def _name_values(command: Callable[..., None]) -> Callable[..., None]:
    """Let the help of a command name the values of its options by what they are, not by their types."""
    for hint in get_type_hints(command, include_extras=True).values():
        infos = [info for info in getattr(hint, "__metadata__", ()) if isinstance(info, OptionInfo)]
        kinds = [kind for kind in (*_inner(hint),) if kind in _NAMES]
        for info in infos:
            if info.metavar is None and kinds:
                info.metavar = _NAMES[kinds[0]]
    return command


def _inner(hint: Any) -> Iterator[Any]:  # noqa: ANN401 - any annotation
    """Yield the types in an annotation, as int in `Annotated[list[int] | None, ...]`."""
    inside = get_args(hint)[:1] if hasattr(hint, "__metadata__") else get_args(hint)
    for one in inside:
        yield from _inner(one)
    if not inside:
        yield hint


TyperArgument.display_type_rich = lambda self, ctx: None  # type: ignore[method-assign]
"""What an argument is, its name says."""
for panel, commands in PANELS.items():
    for name, command in commands.items():
        epilog = f"Example: {EXAMPLES[name]}" if name in EXAMPLES else None
        app.command(name, rich_help_panel=panel, epilog=epilog)(_name_values(command))
app.add_typer(
    starting.app,
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
