import json
from pathlib import Path

import pytest

from astra_data.core.errors import BadInputError, RecipeError
from astra_data.pipeline.recipe import read_tables, recorded_settings


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
        with pytest.raises(RecipeError, match=f"^{path} is {told}$"):
            read_tables(path)
    with pytest.raises(RecipeError, match="cannot be read as a text file"):
        read_tables(tmp_path / ("n" * 300))


def test_a_mapping_in_place_of_a_recipe_is_told() -> None:
    path = Path(__file__).parents[2] / "recipes/imports/nao_guda.toml"
    with pytest.raises(RecipeError) as caught:
        read_tables(path)
    assert str(caught.value) == f"{path} is a mapping: `astra-data import LOGS --mapping {path}`"


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
