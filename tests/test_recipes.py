from pathlib import Path

import pytest

from astra_data.experiment import Recipe
from astra_data.plan import plan
from astra_data.recipe import load_recipe

HOUSE = Path(__file__).parents[1]


@pytest.mark.parametrize("path", sorted((HOUSE / "recipes").glob("*.toml")), ids=lambda path: path.stem)
def test_a_recipe_loads_and_begins_with_the_command_that_runs_it(path: Path) -> None:
    first, recipe = path.read_text().splitlines()[0], load_recipe(path, Recipe)
    assert first == f"# uv run astra-data {'sweep' if recipe.sweep.percent else 'run'} recipes/{path.name}"
    assert plan(recipe, path, Path("runs") / path.stem)
