from pathlib import Path

import pytest

from astra_data.experiment import load_experiment
from astra_data.plan import plan

HOUSE = Path(__file__).parents[1]


@pytest.mark.parametrize("path", sorted((HOUSE / "recipes").glob("*.toml")), ids=lambda path: path.stem)
def test_a_recipe_loads_and_begins_with_the_command_that_runs_it(path: Path) -> None:
    first, experiment = path.read_text().splitlines()[0], load_experiment(path, Path("runs"))
    command = "sweep" if experiment.recipe.sweep.percent else "run"
    assert first == f"# uv run astra-data {command} recipes/{path.name}"
    assert plan(experiment.recipe, path, experiment.folder)


def test_only_the_legs_differ_in_the_morphology_test() -> None:
    experiment = load_experiment(HOUSE / "recipes" / "leg_scale.toml", Path("runs"))
    assert experiment.recipe.evaluate.leg_scale == 1.25
    assert experiment.borrowed == {"collect", "pair", "ground", "train", "align"}
