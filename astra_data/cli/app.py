"""The command line. Commands import what they need when they run, so that `astra-data --help` is fast."""

import logging
import os
import sys
from collections.abc import Callable
from importlib.metadata import version
from typing import Annotated

import typer
from typer.core import TyperArgument, TyperOption

from astra_data.cli import arguments, datasets, recipes, sharing
from astra_data.core.durable import NO_FSYNC, disk_error
from astra_data.core.errors import AstraDataError, BadInputError, missing_extra
from astra_data.core.naming import in_lines, is_text

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
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
    no_fsync: Annotated[
        bool, typer.Option("--no-fsync", help="Do not wait for the disk; a power failure may lose what was written.")
    ] = False,
) -> None:
    """Options before any command."""
    try:
        names = [*sys.argv, os.getcwd()]
    except FileNotFoundError:
        raise BadInputError("the folder that this shell is in was removed or replaced: cd to it again") from None
    if unsound := [name for name in names if not is_text(name)]:
        raise BadInputError(f"{', '.join(unsound)}: expected names in UTF-8: choose others")
    if logging.lastResort is not None:  # what prints warnings
        logging.lastResort.setFormatter(_InLines())
    if no_fsync:
        os.environ[NO_FSYNC] = "1"


PANELS: dict[str, dict[str, Callable[..., None]]] = {
    "Recipes": {
        "new robot --from logs/*.csv": recipes.new,
        "run recipes/quickstart.toml --until ground": recipes.run,
        "check recipes/quickstart.toml cart.py:TASK": recipes.check,
        "ground recipes/quickstart.toml --method astra": recipes.ground,
        "train recipes/quickstart.toml --method astra_plus --device cuda": recipes.train,
        "align recipes/quickstart.toml": recipes.align,
        "evaluate recipes/quickstart.toml --seed 0": recipes.evaluate,
        "report recipes/quickstart.toml": recipes.report,
        "select runs/cart --row astra --trials 40": recipes.select,
        "deploy runs/quickstart --row astra": recipes.deploy,
        "view runs/quickstart --save run.rrd": recipes.view,
    },
    "Recipes or datasets": {
        "collect antmaze-umaze --episodes 50 --name walks": recipes.collect,
        "pair walks --simulator antmaze-umaze": recipes.pair,
        "subset walks --percent 50 --name half": datasets.subset,
    },
    "Datasets": {
        "label logs --task cart.py:TASK": recipes.label,
        "augment walks --episodes 200 --rotations quarter": recipes.augment,
        "merge walks more --name all": datasets.merge,
        "filter walks --success": datasets.filter_,
        "trim logs --start 2 --without 'v < 0.05'": datasets.trim,
        "resample logs --fps 20": datasets.resample,
        "features logs --camera front": datasets.features,
        "list": datasets.list_,
        "inspect walks --plot figures": datasets.inspect,
        "validate walks@data-1.0.0": datasets.validate,
        "repair broken --out repaired": datasets.repair,
        "log walks": datasets.log,
    },
    "Exchange": {
        "import logs/*.csv --mapping logs.toml": sharing.import_,
        "export walks --format d4rl --out walks.hdf5": sharing.export,
        "push walks me/walks": sharing.push,
        "pull me/walks": sharing.pull,
    },
}  # commands by what to type for each, as is said below its help; its first word is its name
_KINDS = {"int": "NUMBER", "float": "NUMBER", "str": "TEXT", "path": "PATH"}
TyperArgument.display_type_rich = lambda self, ctx: None  # type: ignore[method-assign]
"""What an argument is, its name says."""
TyperOption.display_type = (  # type: ignore[method-assign]
    lambda self, ctx: _KINDS.get(self.bare_type().removeprefix("list[").removesuffix("]").lower(), "")
)  # and what an option takes, these words rather than its type
for panel, commands in PANELS.items():
    for example, command in commands.items():
        epilog = f"Example: astra-data {example}"
        app.command(example.split()[0], rich_help_panel=panel, epilog=epilog)(arguments.resumable()(command))
app.add_typer(recipes.shipped, name="recipes", help="List or copy recipes and mappings.", rich_help_panel="Recipes")


def main() -> None:
    """Run the command line; print what is expected to happen as one line unless ASTRA_DATA_DEBUG is set."""
    try:
        app()
    except Exception as error:
        reported: AstraDataError | None = error if isinstance(error, AstraDataError) else disk_error(error)
        if isinstance(error, ModuleNotFoundError):
            reported = missing_extra(error)
        if reported is None or os.environ.get("ASTRA_DATA_DEBUG"):
            raise
        typer.echo(f"error: {in_lines(str(reported))}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
