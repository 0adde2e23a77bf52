"""Whatever a recipe holds: a model, or one clear message."""

import json
import shutil
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from fuzzing import fuzzed, places
from hypothesis import given
from hypothesis import strategies as st

from astra_data.core.config import validated
from astra_data.core.errors import RecipeError
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.recipe import Recipe

RECIPES = sorted((Path(__file__).parents[2] / "recipes").glob("*.toml"))
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


def load(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recipe.toml"
        path.write_bytes(content)
        shutil.copy(RECIPES[0].with_name("antmaze_umaze.toml"), folder)
        try:
            load_experiment(path, Path(folder))
        except RecipeError as error:
            assert str(error).startswith(str(path))


@fuzzed(40)
@given(st.binary(max_size=200))
def test_bytes_that_are_no_recipe(content: bytes) -> None:
    load(content)


@pytest.mark.parametrize("path", RECIPES[::8], ids=lambda path: path.stem)
@fuzzed(40)
@given(place=st.floats(0, 1), text=st.binary(max_size=8), length=st.integers(0, 20))
def test_a_recipe_with_a_damaged_place(path: Path, place: float, text: bytes, length: int) -> None:
    whole = path.read_bytes()
    first = int(place * len(whole))
    load(whole[:first] + text + whole[first + length :])


HOSTILE: st.SearchStrategy[object] = st.one_of(
    st.sampled_from([-1, 0, 1, 2**31, 2**63, 10**18, 10**300, 1e308, -1e308, 1e-308, 0.5, float("nan")]),
    st.sampled_from([True, "", "..", "x" * 300, "\0", [], {}, [[]], [0] * 50, ["nas"] * 3, {"x": 1}]),
    VALUES,
)


def without_none(value: object) -> Any:
    """Leave out what has no value, as TOML does."""
    if isinstance(value, dict):
        return {key: without_none(item) for key, item in value.items() if item is not None}
    return [without_none(item) for item in value] if isinstance(value, list) else value


@cache
def settings_of(path: Path) -> str:
    """Return all settings of a recipe, defaults as well, as JSON."""
    return json.dumps(without_none(load_experiment(path, path.parent).recipe.settings))


@fuzzed(40)
@given(path=st.sampled_from(RECIPES[:4]), share=st.floats(0, 1, exclude_max=True), value=HOSTILE)
def test_a_hostile_value_at_any_key(path: Path, share: float, value: object) -> None:
    tables = json.loads(settings_of(path))
    every = list(places(tables))
    *keys, last = every[int(share * len(every))]
    inner = tables
    for key in keys:
        inner = inner[key]
    inner[last] = value
    with suppress(RecipeError):
        assert validated(tables, Recipe, "recipe").settings
