import re
from pathlib import Path

import pytest
from recordings import MAPPING

from astra_data.core.config import load_recipe
from astra_data.core.errors import RecipeError
from astra_data.dataset.columns import STATE
from astra_data.io.mapping import ColumnMapping, ImportMapping, Jump, Split, read_mapping


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("fps", "fpx"), "fpx: unknown key: did you mean 'fps'"),
        (("fps = 10", "fps = 0"), "fps: expected"),
        (("clip", "clop"), "clop: unknown key"),
        (("columns.action", "columns.actions"), "column actions: did you mean 'action'"),
        (("clip = [-1, 1]", "clip = [1, 1]"), "expected the lower bound first"),
        (('names = ["x", "y"]', 'names = ["x", "x"]'), "names has x more than once"),
        (('"y"]\nscale = [0.001]\nnames = ["x", "y"]', '"x"]'), "fields has x more than once"),
        (("columns.gait", "columns.index"), "column index is filled in"),
        (('columns."next.terminated"', 'columns."next.done"'), "column next.done is filled in"),
        (('fields = ["reward"]', "fields = []"), "columns.next.reward.fields: "),
        (('field = "trial"', 'jump = {column = "pose", values = [0], above = 1}'), "jump.column 'pose'"),
        (('fields = ["fell"]', 'fields = ["fell"]\ndtype = "int64"'), "terminated has dtype int64, expected bool"),
        (("[columns.action]", '[columns.action]\ndtype = "int64"'), "column action has dtype int64, expected float32"),
        (('"next.terminated"', '"next.terminate"'), "column next.terminate: did you mean 'next.terminated'"),
        (('"int64"', '"float64"'), "gait.dtype: expected 'float32', 'int64' or 'bool'"),
    ],
)
def test_faults_are_told(tmp_path: Path, change: tuple[str, str], told: str) -> None:
    path = tmp_path / "mapping.toml"
    path.write_text(MAPPING.replace(*change))
    with pytest.raises(RecipeError) as caught:
        load_recipe(path, ImportMapping)
    assert told in str(caught.value)


def test_the_example_is_a_mapping_and_shows_every_key() -> None:
    path = Path(__file__).parents[2] / "recipes/imports/example.toml"
    load_recipe(path, ImportMapping)
    keys = {key for model in (ImportMapping, ColumnMapping, Split, Jump) for key in model.model_fields}
    assert keys - set(re.findall(r"\w+", path.read_text())) == set()


@pytest.mark.parametrize("recipe", ["quickstart", "nao_real"])
def test_a_recipe_in_place_of_a_mapping_is_told(recipe: str) -> None:
    path = Path(__file__).parents[2] / f"recipes/{recipe}.toml"
    with pytest.raises(RecipeError) as caught:
        read_mapping(path)
    assert str(caught.value) == (
        f"{path} is a recipe: `astra-data run {path}`; expected a mapping, which `astra-data new` writes"
    )


def test_a_gap_of_a_column_is_for_mcap_and_for_what_may_go_stale() -> None:
    state: dict[str, object] = {"fields": ("/odom:x",), "gap_s": 0.1}
    given: dict[str, object] = {"name": "log", "task": "drive", "fps": 10, "columns": {STATE: state}}
    mapping = ImportMapping.model_validate(given)
    mapping.refuse_timeless("mcap", "mapping.toml")
    with pytest.raises(RecipeError, match=r'mapping.toml: columns."observation.state".gap_s: only MCAP has it'):
        mapping.refuse_timeless("csv", "mapping.toml")
    with pytest.raises(ValueError, match="latched holds without limit, and gap_s is a limit"):
        ImportMapping.model_validate(given | {"columns": {STATE: state | {"latched": True}}})
