import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.shipped import RECIPES, START_HERE, copy_recipe, shipped, shipped_recipes
from astra_data.reports.results import merge, read_results


def recipes_of_the_repository() -> set[str]:
    """Names of all that have rows; imports and the like have none."""
    files = (Path(__file__).parents[2] / "recipes").rglob("*.toml")
    tables = {path.stem: tomllib.loads(path.read_text()) for path in files}
    return {name for name, table in tables.items() if {"methods", "based_on"} & table.keys()}


def test_every_recipe_is_shipped_and_says_what_it_is() -> None:
    recipes = [recipe for recipe in shipped_recipes() if not recipe.is_mapping]
    assert [recipe.name for recipe in recipes] == sorted(recipes_of_the_repository())
    for recipe in recipes:
        assert recipe.about.endswith("."), recipe.name
        assert "astra-data run" not in recipe.about
    assert shipped("leg_scale").task == "antmaze-umaze" and shipped("humanoid_extended").task == "humanoid-extended"


@pytest.mark.usefixtures("forgotten_methods")
@pytest.mark.parametrize("name", sorted(recipes_of_the_repository()))
def test_a_copy_has_all_that_it_needs(name: str, tmp_path: Path) -> None:
    copy_recipe(name, tmp_path)
    assert load_experiment(tmp_path / shipped(name).path, tmp_path / "runs").items


def test_a_copy_brings_nothing_but_what_is_needed(tmp_path: Path) -> None:
    def copied(name: str) -> list[str]:
        return sorted(str(path.relative_to(tmp_path / name)) for path in copy_recipe(name, tmp_path / name))

    assert copied("leg_scale") == ["antmaze_umaze.toml", "leg_scale.toml"]
    assert {"imports/nao_guda.toml", "examples/recorded/windows.py"} < {*copied("nao_real")}
    assert copied("quickstart") == [
        *(f"examples/cart/{one}.py" for one in ("camera", "cart", "robot")),
        "quickstart.toml",
    ]
    assert "examples/cart/robot.py" in copied("methods")
    assert "examples/cart/logs.toml" in copied("cart")  # its head names it
    for path in (tmp_path / "quickstart").rglob("*.*"):
        assert path.read_bytes() == (RECIPES / path.relative_to(tmp_path / "quickstart")).read_bytes()


def test_what_is_there_is_kept(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"no recipe 'quickstrat' .*: did you mean 'quickstart'\?"):
        shipped("quickstrat")
    copy_recipe("quickstart", tmp_path)
    assert copy_recipe("quickstart", tmp_path) == []
    changed = tmp_path / "examples/cart/robot.py"
    changed.write_text("TASK = None\n")
    (tmp_path / "quickstart.toml").unlink()
    with pytest.raises(BadInputError, match=r"robot\.py exists and differs"):
        copy_recipe("quickstart", tmp_path)
    assert changed.read_text() == "TASK = None\n" and not (tmp_path / "quickstart.toml").exists()


def test_the_command_line_lists_and_copies(tmp_path: Path) -> None:
    listed = CliRunner().invoke(app, ["recipes", "list"], env={"COLUMNS": "80"}).output.splitlines()
    assert listed[0].strip() == "Recipes" and [line.split()[0] for line in listed[2:5]] == sorted(START_HERE)
    names = [line.split()[0] for line in listed if line.strip()]
    assert [names.count(recipe.name) for recipe in shipped_recipes()] == [1] * len(shipped_recipes())
    assert max(map(len, listed)) <= 80 and "ros2_base" in "\n".join(listed).partition("Mappings")[2]
    copied = CliRunner().invoke(app, ["recipes", "copy", "quickstart", str(tmp_path)])
    assert copied.output == f"finished: 4 files; astra-data run {tmp_path}/quickstart.toml\n"
    assert (tmp_path / "quickstart.toml").is_file()


@pytest.mark.usefixtures("forgotten_methods")
def test_published_results_are_of_their_recipe_and_can_be_added_to(tmp_path: Path) -> None:
    places = [*(RECIPES / "results").glob("*/results.json")]
    assert places
    for place in places:
        found, of = read_results(place), load_experiment(RECIPES / f"{place.parent.name}.toml", tmp_path)
        assert found.recipe == place.parent.name and found.seeds and set(found.seeds) <= set(of.recipe.seeds)
        assert found.rows == tuple(of.recipe.methods) and merge([found, found]).lines == found.lines
        assert of.published() == [place]
