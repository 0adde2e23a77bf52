"""Methods of the user's, as recipes name them, and artifacts that were made with other code of the user's."""

import shutil
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from fake_runs import line, results
from fake_stages import FakeStages
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.naming import CODE
from astra_data.methods import METHODS
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.grounded_env import grounded
from astra_data.pipeline.recipe import UserMethod, add_all, check_unchanged, looked_up, with_offered
from astra_data.pipeline.run import _prepare, check, run
from astra_data.pipeline.trained_policy import load_policy, settings_of
from astra_data.reports.results import results_json
from astra_data.robots import registry

ROWS = ("ground", "train", "evaluate")
ROOT = Path(__file__).parents[2]
DELTA, ENSEMBLE = (f"{ROOT}/recipes/examples/methods/{name}.py:METHOD" for name in ("delta_action", "gru_ensemble"))
pytestmark = pytest.mark.usefixtures("forgotten_methods")
RECIPE = """
task = "rail.py:TASK"
methods = ["nas", "mine"]
seeds = [0]

[user_methods]
mine = "mine.py:METHOD"

[collect]
start = "task"
"""


@pytest.fixture
def made(tmp_path: Path, stages: FakeStages) -> Path:
    """The folder of a recipe with code of the user's, of which a run is made."""
    shutil.copy(ROOT / "tests/small_cart.py", tmp_path / "rail.py")
    shutil.copy(ROOT / "recipes/examples/methods/delta_action.py", tmp_path / "mine.py")
    (tmp_path / "rail.toml").write_text(RECIPE)
    run(tmp_path / "rail.toml", root=tmp_path / "runs")
    return tmp_path


def outdated(folder: Path, recipe: str = "rail.toml") -> dict[str, str]:
    """Return why artifacts are outdated, by stage and row."""
    now = load_experiment(folder / recipe, folder / "runs")
    return {key.rpartition("/")[0]: why.partition(" since")[0] for key in now.items if (why := now.outdated(key))}


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_comments_and_methods_that_come_and_go_outdate_nothing(made: Path) -> None:
    edit(made / "rail.py", "class Rail:", "# On a rail.\n\nclass Rail:")
    whole = (made / "rail.toml").read_text()
    edit(made / "rail.toml", '[user_methods]\nmine = "mine.py:METHOD"\n', "")
    edit(made / "rail.toml", '["nas", "mine"]', '["nas"]')
    assert outdated(made) == {}
    run(made / "rail.toml", root=made / "runs")
    edit(made / "mine.py", "METHOD = ", "EXTRA = METHOD = ")
    (made / "rail.toml").write_text(whole)
    assert outdated(made) == dict.fromkeys([f"{stage}/mine" for stage in ROWS], "mine.py changed")


def test_all_is_outdated_by_another_task_and_its_rows_by_another_method(made: Path) -> None:
    edit(made / "mine.py", "METHOD = ", "EXTRA = METHOD = ")
    assert outdated(made) == dict.fromkeys([f"{stage}/mine" for stage in ROWS], "mine.py changed")
    edit(made / "rail.py", "0.1 * command", "0.2 * command")
    found = outdated(made)
    assert found["collect"] == found["pair"] == found["train/nas"] == "rail.py changed"
    assert found["train/mine"] == "rail.py changed and mine.py changed"
    with pytest.raises(RecipeError, match=r"^rail.py changed and .* since .*runs/rail was made: give the"):
        run(made / "rail.toml", root=made / "runs")


def test_rows_are_outdated_by_other_settings_of_their_method(made: Path) -> None:
    edit(made / "rail.toml", 'mine = "mine.py:METHOD"', 'mine = {method = "mine.py:METHOD", memory = 9}')
    changed = "mine (memory: 32, now 9) changed in the recipe"
    assert outdated(made) == dict.fromkeys([f"{stage}/mine" for stage in ROWS], changed)


@pytest.mark.parametrize("name", ["rail", "rail_of_mine:TASK"])
def test_a_task_of_an_installed_package_is_code_of_the_user_s_too(
    made: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (made / "rail.py").rename(made / "rail_of_mine.py")
    monkeypatch.delitem(sys.modules, "rail_of_mine", raising=False)
    monkeypatch.syspath_prepend(made)
    monkeypatch.setattr(registry, "offered", lambda _: {"rail": "rail_of_mine:TASK"})
    (made / "theirs.toml").write_text((made / "rail.toml").read_text().replace("rail.py:TASK", name))
    run(made / "theirs.toml", root=made / "runs")
    check_unchanged(name, made / "runs/theirs")
    edit(made / "rail_of_mine.py", "0.1 * command", "0.2 * command")
    assert outdated(made, "theirs.toml")["collect"].endswith(" changed")
    with pytest.raises(BadInputError, match=r"^rail_of_mine changed since .* was made: restore that version"):
        check_unchanged(name, made / "runs/theirs")


def test_a_recipe_is_the_same_from_every_folder(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder, path in ((made, "rail.toml"), (made.parent, f"{made.name}/rail.toml")):
        monkeypatch.chdir(folder)
        load_experiment(Path(path), made / "runs").check_unchanged()
    (made / "two").mkdir()
    shutil.copy(made / "rail.py", made / "two/rail.py")
    (made / "other.toml").write_text('based_on = "rail"\ntask = "two/rail.py:TASK"\n')
    with pytest.raises(RecipeError, match=r"task: expected that of rail, .*rail\.py:.*', or one with"):
        load_experiment(made / "other.toml", made / "runs")


@pytest.mark.parametrize(
    "asked", ["deploy runs/rail --row nas --out out", "select runs/rail", "view runs/rail --save out.rrd"]
)
def test_no_command_takes_a_run_of_another_task(asked: str, made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(made)
    edit(made / "rail.py", '"v": (-1.0, 4.0)', '"v": (-1.0, 9.0)')
    before = sorted(made.rglob("*"))
    shown = CliRunner().invoke(app, asked.split())
    assert shown.exit_code == 1 and isinstance(shown.exception, BadInputError)
    assert str(shown.exception) == (
        f"{made}/rail.py changed since runs/rail was made: restore that version, or run the recipe under another name"
    )
    assert sorted(made.rglob("*")) == before
    for load in (load_policy, grounded):
        with pytest.raises(BadInputError, match=f"^{made}/rail.py changed since {made}/runs/rail was made"):
            load(made / "runs/rail", "nas")


def test_no_policy_is_of_another_method(made: Path) -> None:
    edit(made / "mine.py", "METHOD = ", "EXTRA = METHOD = ")
    with pytest.raises(BadInputError, match=f"^{made}/mine.py changed since .* was made: restore that version"):
        load_policy(made / "runs/rail", "mine")
    assert settings_of(made / "runs/rail")["task"] == f"{made}/rail.py:TASK"


@pytest.mark.parametrize("text", ["", '{"task": 3}'])
def test_a_damaged_record_is_told(text: str, made: Path) -> None:
    record = made / "runs/rail" / CODE
    record.write_text(text)
    with pytest.raises(BadInputError, match=r"rail/code\.json is not what a run writes: .*; restore it"):
        settings_of(made / "runs/rail")
    with pytest.raises(BadInputError, match=r"rail/code\.json is not what a run writes"):
        check(made / "rail.toml", root=made / "runs")
    record.unlink()
    settings_of(made / "runs/rail")


def test_a_place_alone_is_a_method_with_its_usual_settings() -> None:
    add_all({"delta": DELTA, "plain": {"method": ENSEMBLE}})
    assert {"delta", "plain"} <= METHODS.keys()
    own = UserMethod.model_validate(DELTA)
    settings = own.settings("delta")
    assert settings is not None and settings.model_dump() == {"memory": 32, "learning_rate": 0.003}
    assert own.model_dump() == {"method": DELTA}
    assert UserMethod.model_validate(ENSEMBLE).settings("plain") is None


def test_the_process_of_an_item_has_the_code_the_run_began_with(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told, own = list[int](), UserMethod.model_validate(f"{made}/mine.py:METHOD")
    prepare = partial(_prepare, f"{made}/rail.py:TASK", {"mine": own}, made / "runs/rail")
    monkeypatch.setattr("torch.set_num_threads", told.append)
    for file, old, new in (("rail.py", "0.1 * command", "0.5 * command"), ("mine.py", "float = 3e-3", "float = 3e-4")):
        edit(made / file, old, new)
        with pytest.raises(BadInputError, match=rf"{file} changed since .*runs/rail was made: restore that version"):
            prepare()
        edit(made / file, new, old)
    prepare()
    edit(made / "mine.py", old, new)
    prepare()  # what it has loaded is not edited
    assert "mine" in METHODS and told == [1, 1, 1, 1]


def test_files_are_looked_up_beside_the_recipe() -> None:
    given = {"a": "a.py:METHOD", "b": {"method": "b.py:METHOD", "memory": 5}, "c": "package.mod:METHOD", "d": 7}
    a, b = {"method": "there/a.py:METHOD"}, {"method": "there/b.py:METHOD", "memory": 5}
    assert looked_up(given, Path("there")) == {"a": a, "b": b, "c": {"method": "package.mod:METHOD"}, "d": 7}


def test_those_that_packages_offer_are_as_if_the_recipe_gave_their_places(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = {"theirs": "their.module:METHOD", "unused": "no.module:METHOD", "nas": "no.module:METHOD"}
    monkeypatch.setattr("astra_data.methods.offered", lambda _: offered)
    tables = {"methods": ["nas", "theirs_plus"], "theirs": {"memory": 5}, "user_methods": {"mine": DELTA}}
    both = {"mine": DELTA, "theirs": {"memory": 5, "method": "their.module:METHOD"}}
    found = with_offered(tables, ("methods", "user_methods"))
    assert found == {"methods": ["nas", "theirs_plus"], "user_methods": both}
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
