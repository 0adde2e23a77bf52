from pathlib import Path

import pytest

from astra_data.errors import RecipeError
from astra_data.plan import Recipe, plan
from astra_data.recipe import load_recipe

HEAD = 'task = "maze"\nmethods = ["follower", "direct_transfer", "astra", "astra_plus"]\nseeds = [0, 7]\n'


def load(folder: Path, model: type[Recipe], text: str) -> Recipe:
    path = folder / "r.toml"
    path.write_text(text)
    return load_recipe(path, model)


def test_rows_read_what_their_method_needs(tmp_path: Path, fake_recipe: type[Recipe]) -> None:
    recipe = load(tmp_path, fake_recipe, HEAD)
    items = {item.key: item for item in plan(recipe, tmp_path / "r.toml", tmp_path)}
    assert len(items) == 2 * (1 + 1 + 1 + 3 + 1 + 4) + 1
    assert items["ground/astra/seed_7"].inputs == ("pair/seed_7",)
    assert items["train/direct_transfer/seed_0"].inputs == ("pair/seed_0",)
    assert items["train/astra_plus/seed_0"].inputs == ("pair/seed_0", "ground/astra/seed_0")
    assert items["evaluate/follower/seed_0"].inputs == ()
    assert items["evaluate/astra_plus/seed_0"].inputs == (
        "train/astra_plus/seed_0",
        "ground/astra/seed_0",
        "align/astra/seed_0",
    )
    assert len(items["report"].inputs) == 8


def test_rows_are_tested_in_one_grounded_simulator_if_the_recipe_has_it(
    tmp_path: Path, fake_recipe: type[Recipe]
) -> None:
    text = HEAD.replace('"astra_plus"', '"nas_plus"')
    items = {
        item.key: item for item in plan(load(tmp_path, fake_recipe, text), tmp_path / "r.toml", tmp_path)
    }
    assert items["evaluate/follower/seed_7"].inputs == ("ground/nas/seed_7",)
    assert items["evaluate/nas_plus/seed_7"].inputs == ("train/nas_plus/seed_7", "ground/nas/seed_7")
    assert items["evaluate/astra/seed_7"].inputs[-1] == "ground/nas/seed_7"


def test_a_method_may_borrow_a_grounding_and_go_on_from_a_policy(
    tmp_path: Path, fake_recipe: type[Recipe]
) -> None:
    text = 'task = "maze"\nmethods = ["astra_again", "fine_tuned"]\nseeds = [0]\n'
    items = {
        item.key: item for item in plan(load(tmp_path, fake_recipe, text), tmp_path / "r.toml", tmp_path)
    }
    assert {"ground/astra/seed_0", "align/astra/seed_0", "train/direct_transfer/seed_0"} <= items.keys()
    assert "ground/astra_again/seed_0" not in items and "evaluate/direct_transfer/seed_0" not in items
    assert items["train/fine_tuned/seed_0"].inputs == ("pair/seed_0", "train/direct_transfer/seed_0")
    assert items["evaluate/astra_again/seed_0"].inputs == (
        "train/astra_again/seed_0",
        "ground/astra/seed_0",
        "align/astra/seed_0",
    )


def test_every_artefact_comes_after_those_it_reads(tmp_path: Path, fake_recipe: type[Recipe]) -> None:
    seen: set[str] = set()
    for item in plan(load(tmp_path, fake_recipe, HEAD), tmp_path / "r.toml", tmp_path):
        assert seen.issuperset(item.inputs)
        seen.add(item.key)


def test_plus_lies_over_train(tmp_path: Path, fake_recipe: type[Recipe]) -> None:
    recipe = load(tmp_path, fake_recipe, HEAD + "[train]\nsteps = 5\n[plus]\nrate = 2\n")
    assert recipe.train.model_dump() == {"steps": 5, "rate": 0.5, "fails": False}
    assert recipe.plus.model_dump() == {"steps": 5, "rate": 2.0, "fails": False}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (HEAD + "[plus]\nstep = 1", "plus.step: unknown key: did you mean 'steps'?"),
        (HEAD + "plus = 1", "plus: expected a table, got 1"),
        (HEAD + "[train]\nsteps = 'x'\n[plus]\nrate = 1.0", "train.steps: expected a whole number, got 'x'"),
        (HEAD.replace("astra_", "astro_"), "methods: unknown method 'astro_plus': did you mean 'astra'?"),
        (HEAD.replace("maze", "moon"), "task: unknown task 'moon'; known: maze"),
        (
            HEAD.replace("astra_plus", "fine_tuned_plus"),
            "methods: 'fine_tuned_plus' trains nothing in a simulator, so the [plus] settings are without "
            "effect: leave out _plus",
        ),
        (HEAD.replace("7", "0"), "recipe: expected each of seeds once, got [0, 0]"),
        (HEAD.replace("[0, 7]", "[]"), "seeds: tuple should have at least 1 item after validation, not 0"),
    ],
)
def test_faults_are_told(tmp_path: Path, fake_recipe: type[Recipe], text: str, expected: str) -> None:
    with pytest.raises(RecipeError) as caught:
        load(tmp_path, fake_recipe, text)
    assert str(caught.value) == f"{tmp_path / 'r.toml'}: {expected}"
