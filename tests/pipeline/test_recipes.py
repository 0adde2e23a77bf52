from pathlib import Path

import pytest

from astra_data.core.errors import RecipeError
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.plan import plan

HOUSE = Path(__file__).parents[2]


EXAMPLES = [path for path in (HOUSE / "recipes/examples").glob("*/*.toml") if path.name != "logs.toml"]


@pytest.mark.usefixtures("forgotten_methods")
@pytest.mark.parametrize("path", sorted({*(HOUSE / "recipes").glob("*.toml"), *EXAMPLES}), ids=lambda path: path.stem)
def test_a_recipe_loads_and_begins_with_the_command_that_runs_it(path: Path) -> None:
    first, experiment = path.read_text().split("\n\n")[0], load_experiment(path, Path("runs"))
    assert any(
        line.removesuffix(" --until ground").endswith(f"astra-data run {path.relative_to(HOUSE)}")
        for line in first.splitlines()
    )
    assert plan(experiment.recipe, path, experiment.folder)


HUMANOID = 'task = "humanoid-walker2d"\nmethods = ["astra"{}]\nseeds = [0]\n[collect]\n'


@pytest.mark.parametrize(
    ("more", "end", "asked"),
    [
        (', "rma", "follower"', "", "methods: follower"),
        ("", "clearance_m = 0.2\n[augment]\nepisodes = 9\n", "augment, collect.clearance_m"),
        ("", 'start = "anywhere"\n', 'collect.start = "anywhere"'),
        ("", "[evaluate]\nleg_scale = 1.25\n", "evaluate.leg_scale"),
        ("", "[report.paper_success]\nastra = 0.4\n", "report.paper_success"),
    ],
)
def test_what_needs_a_maze_is_refused_where_there_is_none(tmp_path: Path, more: str, end: str, asked: str) -> None:
    path = tmp_path / "humanoid.toml"
    path.write_text(HUMANOID.format(""))
    assert load_experiment(path, tmp_path).recipe.task == "humanoid-walker2d"
    path.write_text(HUMANOID.format(more) + end)
    with pytest.raises(RecipeError, match=f"humanoid-walker2d has no maze, which these need: {asked};"):
        load_experiment(path, tmp_path)


def test_legs_of_another_length_are_for_tasks_that_have_them(tmp_path: Path) -> None:
    path = tmp_path / "legs.toml"
    recipe = 'task = "{}"\nmethods = ["astra"]\nseeds = [0]\n[evaluate]\nleg_scale = {}\n'
    for given in (("nao-navigation", 1.0), ("antmaze-umaze", 1.25)):
        path.write_text(recipe.format(*given))
        assert load_experiment(path, tmp_path).recipe.evaluate.leg_scale == given[1]
    path.write_text(recipe.format("nao-navigation", 1.25))
    with pytest.raises(RecipeError, match=r"evaluate\.leg_scale: nao-navigation has legs of one length"):
        load_experiment(path, tmp_path)


def test_robots_start_no_training_in_recorded_states(tmp_path: Path) -> None:
    path, cart = tmp_path / "cart.toml", HOUSE / "recipes/examples/cart/robot.py"
    started = f'task = "{cart}:TASK"\nmethods = ["nas", {{}}]\nseeds = [0]\n[train]\n'
    for text in (started.format('"direct_transfer"'), f"{started}data_start_share = 0.0".format('"target"')):
        path.write_text(text)
        load_experiment(path, tmp_path)
    path.write_text(started.format('"target"'))
    with pytest.raises(RecipeError, match=r"data_start_share: .*would start: methods: target: expected 0$"):
        load_experiment(path, tmp_path)
    path.write_text(started.format('"target"').replace(f"{cart}:TASK", "antmaze-umaze"))
    load_experiment(path, tmp_path)
