"""`astra-data new`, `recipes list` and `recipes copy`: what to begin with."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import show_table

_NAMED = 5  # files that are named in a line


def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the robot: a-z, 0-9 and _.")],
    logs: Annotated[
        list[Path] | None, typer.Option("--from", help="The robot's logs: CSV files, folders of them, or a dataset.")
    ] = None,
    more: Annotated[
        list[Path] | None, typer.Argument(metavar="[LOG]...", help="More logs, so that --from logs/*.csv works.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="The new folder.", show_default="NAME")] = None,
) -> None:
    """Start a project for your own robot: a task, a recipe, a mapping of its logs, a test and a page."""
    from rich.table import Table

    from astra_data.core.errors import BadInputError
    from astra_data.core.naming import first_few
    from astra_data.pipeline.first_simulator import CLEARLY, JUDGED_STEPS
    from astra_data.pipeline.new_robot import write_robot

    places = [*(logs or ()), *(more or ())]
    if not places:
        raise BadInputError(
            "expected the robot's logs, --from LOGS: CSV files, folders of them, or a dataset; without any, "
            "begin with the files of `astra-data recipes copy cart`"
        )
    folder = out or Path(name)
    simulator = write_robot(name, folder, places)
    found = simulator.logs
    table = Table("field", "used as", "unit", "factor", "why")
    for field in found.fields:
        table.add_row(field.name, field.taken_for, field.unit, f"{field.scale:.4g}", field.why)
    show_table(table)
    typer.echo(f"abstract simulator: {simulator.described}")
    simulated, still = simulator.errors()
    worse = [one for one, is_worse in zip(simulator.names, simulated > CLEARLY * still, strict=True) if is_worse]
    if worse:
        typer.echo(
            f"after {JUDGED_STEPS} steps it predicts {' and '.join(worse)} of the logs worse than standing "
            f"still would: edit `step` in {folder}/{name}.py"
        )
    for line in (found.uneven, found.still):
        if line:
            typer.echo(f"{line} (CHECK)")
    for field_name, count in found.left_out.items():
        typer.echo(f"{field_name} is not a number in {count} rows, which are left out: see logs.toml (CHECK)")
    if found.cut_off:
        files = first_few(found.cut_off, _NAMED)
        typer.echo(f"{files}: the last line is cut off and is left out, as it is by an import")
    typer.echo(f"finished: {folder}; see {folder}/README.md for the next steps; CHECK marks guesses")


app = typer.Typer(no_args_is_help=True)


@app.command("list")
def list_() -> None:
    """List the package's recipes and how long they take, and its mappings for `import`."""
    from rich.table import Table
    from rich.text import Text

    from astra_data.pipeline.shipped import START_HERE, listed

    for title, recipes in listed().items():
        table = Table("name", "takes", "what it is", title=title, title_justify="left", box=None)
        for column in table.columns[:2]:
            column.no_wrap = True  # the last one gives way
        for recipe in recipes:
            summary = Text(recipe.summary, no_wrap=True, overflow="ellipsis")
            table.add_row(recipe.name, recipe.duration, summary)
        show_table(table)
        typer.echo()
    typer.echo(f"To begin: astra-data recipes copy {START_HERE[0]}")


@app.command()
def copy(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A name shown by `recipes list`.")],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to copy to.")] = Path("recipes"),
) -> None:
    """Copy a recipe or mapping, with the recipe it is based on and the code it needs."""
    from astra_data.pipeline.shipped import IMPORTS, copy_recipe, shipped

    new = copy_recipe(name, folder)
    path = shipped(name).path
    place = folder / path
    how = f"import LOGS --mapping {place}" if path.parts[0] == IMPORTS else f"run {place}"
    typer.echo(f"finished: {len(new)} files; astra-data {how}")
