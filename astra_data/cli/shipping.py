"""`astra-data recipes list` and `astra-data recipes copy`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import show_table

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
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="A name shown by `recipes list`.", show_default=False)
    ],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to copy to.")] = Path("recipes"),
) -> None:
    """Copy a recipe or mapping, with the recipe it is based on and the code it needs."""
    from astra_data.pipeline.shipped import IMPORTS, copy_recipe, shipped

    new = copy_recipe(name, folder)
    path = shipped(name).path
    place = folder / path
    how = f"import LOGS --mapping {place}" if path.parts[0] == IMPORTS else f"run {place}"
    typer.echo(f"finished: {len(new)} files; astra-data {how}")
