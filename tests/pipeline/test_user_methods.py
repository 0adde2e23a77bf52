"""Methods of one's own, as recipes name them."""

from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import line, results

from astra_data.core.errors import RecipeError
from astra_data.methods import METHODS
from astra_data.pipeline import run
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.recipe import UserMethod, add_all, looked_up, with_offered
from astra_data.reports.results import results_json

EXAMPLES = Path(__file__).parents[2] / "recipes/examples/methods"
pytestmark = pytest.mark.usefixtures("forgotten_methods")
DELTA, ENSEMBLE = (f"{EXAMPLES}/{name}.py:METHOD" for name in ("delta_action", "gru_ensemble"))


def test_a_place_alone_is_a_method_with_its_usual_settings() -> None:
    add_all({"delta": DELTA, "plain": {"method": ENSEMBLE}})
    assert {"delta", "plain"} <= METHODS.keys()
    own = UserMethod.model_validate(DELTA)
    settings = own.settings("delta")
    assert settings is not None and settings.model_dump() == {"memory": 32, "learning_rate": 0.003}
    assert own.model_dump() == {"method": DELTA}
    assert UserMethod.model_validate(ENSEMBLE).settings("plain") is None


def test_the_process_of_an_item_knows_them_and_uses_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[int] = []
    monkeypatch.setattr("torch.set_num_threads", told.append)
    run._prepare({"one": UserMethod.model_validate(DELTA)})
    assert "one" in METHODS and told == [1]


def test_files_are_looked_up_beside_the_recipe() -> None:
    found = looked_up(
        {"a": "a.py:METHOD", "b": {"method": "b.py:METHOD", "memory": 5}, "c": "package.mod:METHOD", "d": 7},
        Path("there"),
    )
    assert found == {
        "a": {"method": "there/a.py:METHOD"},
        "b": {"method": "there/b.py:METHOD", "memory": 5},
        "c": {"method": "package.mod:METHOD"},
        "d": 7,
    }


def test_those_that_packages_offer_are_named_as_if_the_recipe_gave_their_places(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    offered = {"theirs": "their.module:METHOD", "unused": "no.module:METHOD", "nas": "no.module:METHOD"}
    monkeypatch.setattr("astra_data.methods.offered", lambda _: offered)
    tables = {"methods": ["nas", "theirs_plus"], "theirs": {"memory": 5}, "user_methods": {"mine": DELTA}}
    assert with_offered(tables, ("methods", "user_methods")) == {
        "methods": ["nas", "theirs_plus"],
        "user_methods": {"mine": DELTA, "theirs": {"memory": 5, "method": "their.module:METHOD"}},
    }
    for as_it_is in ({"methods": ["nas"], "mine": {}}, {"methods": "theirs"}, {"theirs": 5}):
        assert with_offered(as_it_is, ("methods", "user_methods")) == as_it_is
    given = {"methods": ["theirs"], "user_methods": {"theirs": DELTA}}
    assert with_offered(given, ("methods", "user_methods")) == given


OWN = """task = "antmaze-umaze"
methods = ["delta", "nas"]
seeds = [0]
[user_methods]
delta = {{ method = "{place}", memory = {memory} }}
"""


def test_a_recipe_that_changes_their_settings_borrows_nothing_made_with_those_of_its_base(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text(OWN.format(place=DELTA, memory=32))
    other = tmp_path / "other.toml"
    for memory, borrowed in ((32, {"collect", "pair", "ground", "train", "evaluate"}), (8, None)):
        other.write_text(f'based_on = "base"\n{OWN.format(place=DELTA, memory=memory)}')
        assert load_experiment(other, tmp_path).borrowed == (borrowed or {"collect", "pair"})
    # Another method that the base does not know of changes nothing of it.
    other.write_text(f'based_on = "base"\n[user_methods]\nplain = "{ENSEMBLE}"\n')
    assert "ground" in load_experiment(other, tmp_path).borrowed
    # That its default is written out is no change.
    (tmp_path / "base.toml").write_text(OWN.format(place=DELTA, memory=32).replace(", memory = 32", ""))
    other.write_text(f'based_on = "base"\n{OWN.format(place=DELTA, memory=32)}')
    assert "ground" in load_experiment(other, tmp_path).borrowed


def test_results_that_were_published_with_other_settings_of_theirs_are_not_the_recipe_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tmp_path / "own.toml"
    recipe.write_text(OWN.format(place=DELTA, memory=32))
    settings = load_experiment(recipe, tmp_path).recipe.settings

    def published(**changes: object) -> None:
        row = "nas" if changes.pop("other", None) else "delta"
        (tmp_path / "results/own").mkdir(parents=True, exist_ok=True)
        found = results(line(row, 0, success=0.0), settings=settings | changes)
        (tmp_path / "results/own/results.json").write_text(results_json(found))

    published()
    assert len(load_experiment(recipe, tmp_path).published()) == 1
    recipe.write_text(OWN.format(place=DELTA, memory=8))
    with pytest.raises(RecipeError, match=r"^delta \(memory: 32, now 8\) changed in .* since the results"):
        load_experiment(recipe, tmp_path).published()
    other = {"user_methods": {"delta": {"method": DELTA, "no_setting": 3}}}
    published(**other)
    with pytest.raises(RecipeError, match=r"^delta \(.*no_setting: 3, now none"):
        load_experiment(recipe, tmp_path).published()
    published(other=True, **other)
    assert len(load_experiment(recipe, tmp_path).published()) == 1


@pytest.mark.parametrize("initial", ["nas", "follower", "delta"])
def test_what_a_policy_starts_from_is_learned_without_a_fit(
    initial: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever of a recipe's methods is read first."""
    monkeypatch.setitem(METHODS, "begun", replace(METHODS["direct_transfer_iql"], name="begun", initial=initial))
    recipe = tmp_path / "r.toml"
    text = 'task = "antmaze-umaze"\nmethods = ["begun"]\nseeds = [0]\n[collect]\n[user_methods]\n'
    recipe.write_text(f'{text}delta = "{DELTA}"\n')
    with pytest.raises(RecipeError, match=f"methods: 'begun' starts from the policy of {initial}: expected a method"):
        load_experiment(recipe, tmp_path)


@pytest.mark.parametrize("row", ["delta", "delta_plus", "astra"])
@pytest.mark.parametrize("table", ["compare = ['{}']", "trajectory_methods = ['{}']", "paper_success.{} = 0.5"])
def test_a_report_names_them_like_others_and_a_wrong_name_is_told_before_the_run(
    tmp_path: Path, row: str, table: str
) -> None:
    path = tmp_path / "own.toml"
    recipe = OWN.format(place=DELTA, memory=32) + "[report]\n"
    path.write_text(recipe + table.format(row))
    load_experiment(path, tmp_path)
    path.write_text(recipe + table.format("delt"))
    with pytest.raises(RecipeError, match=r"report\.(compare|trajectory_methods|paper_success): unknown .*'delt'"):
        load_experiment(path, tmp_path)
