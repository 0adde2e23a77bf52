from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from astra_data.core.config import validated
from astra_data.methods import METHODS
from astra_data.pipeline.executors import Item
from astra_data.pipeline.plan import plan, stage_of
from astra_data.pipeline.recipe import Recipe
from astra_data.pipeline.staleness import reads, stale_stages

ROWS = [*METHODS, "astra_plus", "direct_transfer_plus"]


def planned(rows: list[str]) -> dict[str, Item]:
    recipe = validated({"task": "antmaze-umaze", "methods": rows, "seeds": [0]}, Recipe, "recipe")
    return {item.key: item for item in plan(recipe, Path("r.toml"), Path("runs/r"))}


def made_from(key: str, items: dict[str, Item]) -> Iterator[str]:
    """Yield the stages of the artifact `key` and of all that it is made from."""
    yield stage_of(items[key])
    for source in items[key].inputs:
        yield from made_from(source, items)


@pytest.mark.parametrize("row", ROWS)
def test_a_row_depends_on_the_stages_that_it_is_made_from(row: str) -> None:
    items = planned([row])
    evaluated = set(made_from(f"evaluate/{row}/seed_0", items))
    assert reads(row, "align") == ("align" in evaluated)
    assert reads(row, "ground") == ("ground" in evaluated)
    if METHODS[row.removesuffix("_plus")].trains:
        assert reads(row, "ground") == ("ground" in made_from(f"train/{row}/seed_0", items))


def test_with_the_reference_all_evaluations_depend_on_its_grounding_and_no_other_training() -> None:
    items = planned([*(row for row in METHODS if not METHODS[row].grounds), "nas"])
    for key in items:
        stage, _, row = key.partition("/")
        if stage == "evaluate":
            assert "ground" in made_from(key, items)
        elif stage == "train":
            assert ("ground" in made_from(key, items)) == (row == "nas/seed_0")


def test_a_row_of_an_unknown_method_may_have_been_grounded() -> None:
    assert reads("gone", "ground") and reads("gone_plus", "align")
    assert not reads("gone", "target")


def test_a_row_depends_on_what_the_row_that_it_goes_on_from_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    for first, is_grounded in (("nas", True), ("direct_transfer", False)):
        monkeypatch.setitem(METHODS, "further", replace(METHODS["direct_transfer"], initial=first))
        assert reads("further", "ground") is is_grounded


def test_other_data_outdate_what_is_made_of_them_and_no_collection() -> None:
    stale = stale_stages({"data"})
    assert {"label", "pair", "ground", "train", "align", "evaluate"} <= stale and "collect" not in stale
    assert "collect" in stale_stages({"collect"}) and "label" not in stale_stages({"collect"})
