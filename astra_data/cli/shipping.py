"""`astra-data recipes list` and `astra-data recipes copy`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.showing import show_table

app = typer.Typer(no_args_is_help=True)


@app.command("list")
def list_() -> None:
    """List the package's recipes, and its mappings for `import`."""
    from rich.table import Table

    from astra_data.experiments.shipped import shipped_mappings, shipped_recipes

    table = Table("recipe", "task", "what it is")
    for recipe in shipped_recipes():
        table.add_row(recipe.name, recipe.task, recipe.about)
    for mapping in shipped_mappings():
        table.add_row(mapping.name, "(a mapping, for import)", mapping.about)
    show_table(table)


@app.command()
def copy(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="A name shown by `recipes list`.", show_default=False)
    ],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to copy to.")] = Path("recipes"),
) -> None:
    """Copy a recipe or mapping, with the recipe it is based on and the code it needs."""
    from astra_data.experiments.shipped import IMPORTS, copy_recipe, shipped

    new = copy_recipe(name, folder)
    path = shipped(name).path
    place = folder / path
    how = f"import LOGS --mapping {place}" if path.parts[0] == IMPORTS else f"run {place}"
    typer.echo(f"finished: {len(new)} files; astra-data {how}")
