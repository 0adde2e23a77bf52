"""`astra-data recipes list` and `astra-data recipes copy`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.showing import show_table

app = typer.Typer(no_args_is_help=True)


@app.command("list")
def list_() -> None:
    """List the recipes that come with the package."""
    from rich.table import Table

    from astra_data.experiments.shipped import shipped_recipes

    table = Table("recipe", "task", "what it is")
    for recipe in shipped_recipes():
        table.add_row(recipe.name, recipe.task, recipe.about)
    show_table(table)


@app.command()
def copy(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Of a recipe that `recipes list` shows.", show_default=False)
    ],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where to.")] = Path("recipes"),
) -> None:
    """Copy a recipe, with the recipe that it is based on and the code of its task."""
    from astra_data.experiments.shipped import copy_recipe, shipped

    new = copy_recipe(name, folder)
    typer.echo(f"finished: {len(new)} files; astra-data run {folder / shipped(name).path}")
