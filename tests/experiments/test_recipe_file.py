import json
from pathlib import Path

import pytest

from astra_data.core.config import load_recipe
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.experiments.recipe import Recipe
from astra_data.experiments.recipe_file import (
    is_gap_recipe,
    read_tables,
    recorded_settings,
    with_current_keys,
)
from astra_data.studies.run import load_gap_recipe

RECIPE = """
task = "antmaze-umaze"
methods = ["astra_plus"]
seeds = [0]
ground.correction_heads = 2
train.{train} = 0.5
plus.{plus} = 2.0
"""


def test_old_keys_are_taken_with_a_message_each(capsys: pytest.CaptureFixture[str]) -> None:
    tables = {
        "task": "a",
        "train": {"ramp": 0.1, "doubt_penalty": 0.5},
        "plus": {"doubt_penalty": 1.0},
        "align": {},
    }
    for _ in range(2):
        current = with_current_keys(tables, Path("old.toml"))
    assert current == tables | {
        "train": {"ramp": 0.1, "disagreement_penalty": 0.5},
        "plus": {"disagreement_penalty": 1.0},
    }
    assert capsys.readouterr().err.splitlines() == [
        f"old.toml: {table}.doubt_penalty is now called disagreement_penalty: please rename it"
        for table in ("train", "plus")
    ]


def test_a_run_or_a_dataset_in_place_of_a_recipe_is_told(tmp_path: Path) -> None:
    run, pairs, other = tmp_path / "mec", tmp_path / "mec/pair/seed_0", tmp_path / "walks"
    for dataset in (pairs, other):
        (dataset / "meta").mkdir(parents=True)
        (dataset / "meta/info.json").touch()
    (run / "recipe.json").touch()
    for path, told in (
        (run, "a run: expected the recipe that made it, mec.toml"),
        (pairs, "a dataset: expected the recipe that made it, mec.toml"),
        (other, "a dataset: expected the recipe that made it"),
        (tmp_path, "a folder: expected a TOML file"),
    ):
        for read in (read_tables, is_gap_recipe, load_gap_recipe):
            with pytest.raises(RecipeError, match=f"^{path} is {told}$"):
                read(path)
    with pytest.raises(RecipeError, match="cannot be read as a text file"):
        read_tables(tmp_path / ("n" * 300))


def test_a_mapping_in_place_of_a_recipe_is_told() -> None:
    path = Path(__file__).parents[2] / "recipes/imports/nao_guda.toml"
    for read in (read_tables, is_gap_recipe, load_gap_recipe):
        with pytest.raises(RecipeError) as caught:
            read(path)
        assert str(caught.value) == f"{path} is a mapping: `astra-data import LOGS --mapping {path}`"


def test_a_table_may_have_several_old_keys() -> None:
    old = {"plus": {"doubt_penalty": 1.0, "command_limit_m_s": 0.5, "ramp": 0.1}}
    new = {"disagreement_penalty": 1.0, "command_limit": 0.5, "ramp": 0.1}
    assert with_current_keys(old, Path("older.toml")) == {"plus": new}


def test_current_keys_are_taken_without_a_word(capsys: pytest.CaptureFixture[str]) -> None:
    tables = {"train": {"disagreement_penalty": 0.5}, "plus": {}}
    assert with_current_keys(tables, Path("new.toml")) == tables
    assert not capsys.readouterr().err


def test_both_names_in_one_table_are_refused() -> None:
    tables = {"plus": {"disagreement_penalty": 0.5, "doubt_penalty": 0.5}}
    with pytest.raises(
        RecipeError, match=r"^both\.toml: plus has both doubt_penalty and disagreement_penalty,"
    ):
        with_current_keys(tables, Path("both.toml"))


@pytest.mark.parametrize("train", ["doubt_penalty", "disagreement_penalty"])
@pytest.mark.parametrize("plus", ["doubt_penalty", "disagreement_penalty"])
def test_recipes_with_either_name_are_the_same_and_recorded_by_the_old_one(
    train: str, plus: str, tmp_path: Path
) -> None:
    path = tmp_path / "recipe.toml"
    path.write_text(RECIPE.format(train=train, plus=plus))
    recipe = load_recipe(path, Recipe)
    assert (recipe.train.disagreement_penalty, recipe.plus.disagreement_penalty) == (0.5, 2.0)
    recorded = recipe.settings
    assert [recorded[table]["doubt_penalty"] for table in ("train", "plus")] == [0.5, 2.0]  # type: ignore[index, call-overload]
    assert Recipe.model_validate(recipe.model_dump()) == recipe


def test_what_a_run_recorded_is_read_with_keys_of_any_age(tmp_path: Path) -> None:
    recorded = {"task": "a", "own_methods": {"mine": {"method": "m.py:M", "rate": 0.5}}, "gone": [1, None]}
    (tmp_path / "recipe.json").write_text(json.dumps(recorded))
    assert recorded_settings(tmp_path) == recorded


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "file: Invalid JSON"),
        ('{"task": "a", "seeds": [0', "file: Invalid JSON"),
        ("[]", "file: "),
        ("{}", "task: Field required"),
        ('{"task": 3}', "task: "),
        ('{"task": "a", "sweep": []}', "sweep: "),
        ('{"task": "a", "own_methods": {"mine": {}}}', "own_methods.mine.method: Field required"),
    ],
)
def test_a_damaged_record_is_told(text: str, fault: str, tmp_path: Path) -> None:
    (tmp_path / "recipe.json").write_text(text)
    with pytest.raises(BadInputError) as caught:
        recorded_settings(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path}/recipe.json is not what a run writes: {fault}")
    assert str(caught.value).endswith("or move the folder away and run the recipe again")
    assert "\n" not in str(caught.value)
