import re

import pytest

from astra_data.core.config import validated
from astra_data.core.errors import BadInputError
from astra_data.pipeline.points import RunPoint, Selection
from astra_data.pipeline.recipe import Recipe

ROWS = ("direct_transfer", "astra", "astra_plus")


def recipe(*percents: int) -> Recipe:
    tables = {"task": "antmaze-umaze", "methods": ROWS, "seeds": (0, 7), "sweep": {"percent": percents}}
    return validated(tables, Recipe, "r.toml")


def test_by_default_everything_is_selected() -> None:
    assert Selection.of(recipe(50, 100)) == Selection(ROWS, (0, 7), (50, 100))
    assert Selection.of(recipe()) == Selection(ROWS, (0, 7), ())


def test_what_is_named_is_selected_once_in_the_order_given() -> None:
    asked = Selection.of(recipe(50, 100), ["astra_plus", "astra", "astra_plus"], [7, 7], [100])
    assert asked == Selection(("astra_plus", "astra"), (7,), (100,))


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"methods": ["astro"]}, "the recipe has no method 'astro': did you mean 'astra'?"),
        ({"seeds": [0, 1]}, "the recipe has no seed 1; its seeds: 0, 7"),
        ({"percents": [25]}, "the recipe has no size 25; its sizes: 50, 100"),
    ],
)
def test_what_the_recipe_does_not_have_is_refused(asked: dict[str, list[object]], message: str) -> None:
    with pytest.raises(BadInputError, match=f"^{re.escape(message)}$"):
        Selection.of(recipe(50, 100), **asked)  # type: ignore[arg-type]


def test_a_recipe_without_sizes_says_so() -> None:
    with pytest.raises(BadInputError, match="the recipe has no size 50; its sizes: none"):
        Selection.of(recipe(), percents=[50])


def test_points_are_every_row_on_every_size_of_every_seed() -> None:
    points = Selection(("nas", "astra"), (0, 7), (50, 100)).points()
    assert points[:3] == (RunPoint("nas", 0, 50), RunPoint("nas", 7, 50), RunPoint("nas", 0, 100))
    assert len(set(points)) == len(points) == 8
    assert Selection(("nas",), (3,), ()).points() == (RunPoint("nas", 3),)


def test_a_point_is_finished_with_its_evaluation() -> None:
    assert RunPoint("astra_plus", 7).key == "evaluate/astra_plus/seed_7"
    assert RunPoint("nas", 0, 5).key == "evaluate/nas/percent_005/seed_0"
