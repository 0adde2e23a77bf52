"""Artifacts that were made with other code of the user's."""

import json
import shutil
import sys
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.naming import CODE
from astra_data.pipeline.experiment import Experiment, load_experiment
from astra_data.pipeline.grounded_env import training_of
from astra_data.pipeline.plan import plan
from astra_data.pipeline.trained_policy import load_policy, task_of
from astra_data.pipeline.user_code import check_unchanged, record_code
from astra_data.robots import registry

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.usefixtures("forgotten_methods")
RECIPE = """
task = "rail.py:TASK"
methods = ["nas", "mine"]
seeds = [0]

[own_methods]
mine = "mine.py:METHOD"

[collect]
start = "task"
"""


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """The recipe of a run with folders for each of its stages, as a run leaves them."""
    shutil.copy(ROOT / "tests/small_cart.py", tmp_path / "rail.py")
    shutil.copy(ROOT / "recipes/examples/methods/residual_ensemble.py", tmp_path / "mine.py")
    (tmp_path / "rail.toml").write_text(RECIPE)
    experiment = load(tmp_path)
    for stage in ("collect", "pair", "ground/nas", "ground/mine", "train/nas", "train/mine"):
        (experiment.folder / stage / "seed_0").mkdir(parents=True)
    (experiment.folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    record_code(experiment.recipe, experiment.folder)
    return tmp_path


def load(folder: Path) -> Experiment:
    return load_experiment(folder / "rail.toml", folder / "runs")


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_code_as_it_was_and_comments_outdate_nothing(made: Path) -> None:
    edit(made / "rail.py", "class Rail:", "# On a rail.\n\nclass Rail:")
    experiment = load(made)
    experiment.check_unchanged()
    assert experiment.outdated("train/nas/seed_0") == ""


def test_all_is_outdated_by_another_task(made: Path) -> None:
    edit(made / "rail.py", "0.1 * command", "0.2 * command")
    experiment = load(made)
    for key in ("collect/seed_0", "train/mine/seed_0"):
        assert (
            experiment.outdated(key) == "rail.py changed since: give the recipe another name, or remove this"
        )
    folders = " ".join(str(experiment.folder / stage) for stage in ("collect", "pair", "ground", "train"))
    with pytest.raises(RecipeError, match=f"^rail.py changed since .*, or remove {folders}$"):
        experiment.check_unchanged()


def test_rows_are_outdated_by_another_method(made: Path) -> None:
    edit(made / "mine.py", "METHOD = ", "EXTRA = METHOD = ")
    edit(made / "rail.toml", "[0]", "[0]\n[evaluate]\nepisodes = 7")
    experiment = load(made)
    assert experiment.outdated("ground/mine/seed_0").startswith(
        "evaluate (episodes: 100, now 7) changed in the recipe and mine.py changed"
    )
    assert experiment.outdated("ground/nas/seed_0") == experiment.outdated("collect/seed_0") == ""


def test_rows_are_outdated_by_other_settings(made: Path) -> None:
    shutil.copy(ROOT / "recipes/examples/methods/delta_action.py", made / "other.py")
    edit(made / "rail.toml", 'mine = "mine.py:METHOD"', 'other = {method = "other.py:METHOD", memory = 8}')
    edit(made / "rail.toml", '"mine"', '"other"')
    experiment = load(made)
    (experiment.folder / "ground/other/seed_0").mkdir(parents=True)
    record_code(experiment.recipe, experiment.folder)
    edit(made / "rail.toml", "memory = 8", "memory = 9")
    experiment = load(made)
    assert experiment.outdated("ground/other/seed_0").startswith("the settings of other changed since")
    assert experiment.outdated("ground/nas/seed_0") == ""


def test_rows_are_outdated_by_another_method_of_an_installed_package(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its settings, in a table of its name, too."""
    shutil.copy(ROOT / "recipes/examples/methods/delta_action.py", made / "theirs_of_mine.py")
    monkeypatch.syspath_prepend(made)
    monkeypatch.setattr("astra_data.methods.offered", lambda _: {"theirs": "theirs_of_mine:METHOD"})
    edit(made / "rail.toml", '\n[own_methods]\nmine = "mine.py:METHOD"\n', "\n[theirs]\nmemory = 8\n")
    edit(made / "rail.toml", '"mine"', '"theirs"')
    experiment = load(made)
    settings = experiment.recipe.settings_of("theirs", "ground")
    assert settings is not None and settings.model_dump() == {"memory": 8, "learning_rate": 0.003}
    assert [item.key for item in plan(experiment.recipe, experiment.path, experiment.folder)]
    (experiment.folder / "ground/theirs/seed_0").mkdir(parents=True)
    record_code(experiment.recipe, experiment.folder)
    edit(made / "rail.toml", "memory = 8", "memory = 9")
    assert load(made).outdated("ground/theirs/seed_0").startswith("the settings of theirs changed since")
    edit(made / "rail.toml", "memory = 9", "memory = 8")
    assert load(made).outdated("ground/theirs/seed_0") == ""
    edit(made / "theirs_of_mine.py", "METHOD = ", "EXTRA = METHOD = ")
    assert load(made).outdated("ground/theirs/seed_0").startswith("theirs_of_mine changed since")
    assert load(made).outdated("ground/nas/seed_0") == ""
    edit(made / "rail.toml", "memory", "memroy")
    with pytest.raises(RecipeError, match=r"theirs: memroy: unknown key: did you mean 'memory'"):
        load(made)


@pytest.mark.parametrize("name", ["rail", "rail_of_mine:TASK"])
def test_all_is_outdated_by_another_task_of_an_installed_package(
    made: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (made / "rail.py").rename(made / "rail_of_mine.py")
    monkeypatch.delitem(sys.modules, "rail_of_mine", raising=False)
    monkeypatch.syspath_prepend(made)
    monkeypatch.setattr(registry, "offered", lambda _: {"rail": "rail_of_mine:TASK"})
    edit(made / "rail.toml", "rail.py:TASK", name)
    experiment = load(made)
    (experiment.folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    record_code(experiment.recipe, experiment.folder)
    check_unchanged(name, experiment.folder)
    edit(made / "rail_of_mine.py", "0.1 * command", "0.2 * command")
    assert load(made).outdated("collect/seed_0").startswith("rail_of_mine changed since")
    with pytest.raises(BadInputError, match=r"^rail_of_mine changed since .* was made: restore that version"):
        check_unchanged(name, experiment.folder)


def test_a_method_that_the_recipe_has_no_more_outdates_nothing(made: Path) -> None:
    edit(made / "rail.toml", '"nas", "mine"', '"nas"')
    edit(made / "rail.toml", '[own_methods]\nmine = "mine.py:METHOD"\n', "[iql]\ndiscount = 0.9\n")
    experiment = load(made)
    (experiment.folder / "train/gone/seed_0").mkdir(parents=True)
    experiment.check_unchanged()
    assert experiment.outdated("train/gone/seed_0") == ""


def test_what_it_was_is_known_once_the_method_is_back(made: Path) -> None:
    whole = (made / "rail.toml").read_text()
    edit(made / "rail.toml", '[own_methods]\nmine = "mine.py:METHOD"\n', "")
    edit(made / "rail.toml", '["nas", "mine"]', '["nas"]')
    record_code(load(made).recipe, load(made).folder)
    edit(made / "mine.py", "class ", "class Other:\n    pass\n\n\nclass ")
    (made / "rail.toml").write_text(whole)
    assert "mine.py" in load(made).outdated("train/mine/seed_0")


def test_a_recipe_is_the_same_from_every_folder(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (made / "logs").mkdir()
    record = made / "runs/rail/recipe.json"
    settings = json.loads(record.read_text()) | {"data": None}
    for place in ("rail.py:TASK", f"{made}/rail.py:TASK", "recipes/rail.py:TASK"):
        record.write_text(json.dumps(settings | {"task": place}))
        for folder, path in ((made, "rail.toml"), (made.parent, f"{made.name}/rail.toml")):
            monkeypatch.chdir(folder)
            load_experiment(Path(path), made / "runs").check_unchanged()
    record.write_text(json.dumps(settings | {"task": "rail.py:LOGS_ALONE"}))
    with pytest.raises(RecipeError, match=r'task \(".*", now ".*\) changed in the recipe'):
        load(made).check_unchanged()


def test_another_file_of_the_same_name_is_no_base(made: Path) -> None:
    (made / "two").mkdir()
    shutil.copy(made / "rail.py", made / "two/rail.py")
    (made / "other.toml").write_text('based_on = "rail"\ntask = "two/rail.py:TASK"\n')
    with pytest.raises(RecipeError, match=r"task: expected that of rail, .*rail\.py:TASK', or one with"):
        load_experiment(made / "other.toml", made / "runs")


def test_a_run_of_an_older_version_has_no_record(made: Path) -> None:
    edit(made / "rail.py", "0.1 * command", "0.2 * command")
    (load(made).folder / CODE).unlink()
    load(made).check_unchanged()


@pytest.mark.parametrize(
    "asked",
    [
        "deploy runs/rail --row nas --out out",
        "select runs/rail",
        "select runs/rail --trials 50",
        "view runs/rail --save out.rrd",
    ],
)
def test_no_command_takes_a_run_of_another_task(
    asked: str, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(made)
    edit(made / "rail.py", '"v": (-1.0, 4.0)', '"v": (-1.0, 9.0)')
    before = sorted(made.rglob("*"))
    shown = CliRunner().invoke(app, asked.split())
    assert shown.exit_code == 1 and isinstance(shown.exception, BadInputError)
    assert str(shown.exception) == (
        f"{made}/rail.py changed since runs/rail was made: "
        "restore that version, or run the recipe under another name"
    )
    assert sorted(made.rglob("*")) == before


def test_no_policy_and_no_environment_is_of_another_task(made: Path) -> None:
    edit(made / "rail.py", "0.1 * command", "0.2 * command")
    run = made / "runs/rail"
    for load in (load_policy, partial(training_of, seed=0)):
        with pytest.raises(
            BadInputError, match=f"^{made}/rail.py changed since {run} was made: restore that"
        ):
            load(run, "nas")


@pytest.mark.parametrize("row", ["mine", "mine_plus"])
def test_no_policy_is_of_another_method(made: Path, row: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor of a grounding that another method fits; other rows are."""
    edit(made / "rail.toml", '"mine"]', '"mine", "mine_plus"]')
    run = made / "runs/rail"
    (run / "recipe.json").write_text(load(made).recipe.model_dump_json())

    def refused(row: str) -> str:
        with pytest.raises(BadInputError) as caught:
            load_policy(run, row)
        return str(caught.value)

    assert refused(row).endswith("run the recipe first")
    edit(made / "mine.py", "METHOD = ", "EXTRA = METHOD = ")
    told = f"{made}/mine.py changed since {run} was made: restore that version"
    assert refused(row).startswith(told)
    assert refused("nas").endswith("run the recipe first")
    monkeypatch.setattr("astra_data.pipeline.trained_policy.grounded_as", lambda _: "mine")
    assert refused("nas").startswith(told)
    monkeypatch.setattr("astra_data.pipeline.trained_policy.grounded_as", lambda _: "nas")
    assert refused(row).startswith(told)


def test_a_run_is_taken_with_comments_and_methods_that_are_others(made: Path) -> None:
    edit(made / "rail.py", "class Rail:", "# On a rail.\n\nclass Rail:")
    edit(made / "mine.py", "METHOD = ", "EXTRA = METHOD = ")
    assert task_of(made / "runs/rail") == f"{made}/rail.py:TASK"


def test_only_what_was_recorded_can_be_another_task(
    made: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    run, task = made / "runs/rail", f"{made}/rail.py:TASK"
    for unknown in ("antmaze-umaze", "package.module:TASK", "gone.py:TASK"):
        check_unchanged(unknown, run)
    edit(made / "rail.py", "0.1 * command", "0.2 * command")
    check_unchanged(task, tmp_path_factory.mktemp("older"))
    (run / CODE).write_text('{"mine": "0"}')
    check_unchanged(task, run)
    (run / CODE).write_text("[]")
    with pytest.raises(BadInputError, match=r"rail/code\.json is not what a run writes"):
        check_unchanged(task, run)


def test_built_in_tasks_have_no_record(tmp_path: Path) -> None:
    (tmp_path / "rail.toml").write_text('task = "antmaze-umaze"\nmethods = ["nas"]\nseeds = [0]\n')
    experiment = load(tmp_path)
    record_code(experiment.recipe, tmp_path)
    assert not (tmp_path / CODE).exists()


@pytest.mark.parametrize("text", ["", "[]", '{"task": 3}'])
def test_a_damaged_record_is_told(text: str, made: Path) -> None:
    record = load(made).folder / CODE
    record.write_text(text)
    with pytest.raises(BadInputError, match=r"rail/code\.json is not what a run writes: .*; restore it"):
        load(made).check_unchanged()
    record.unlink()
    load(made).check_unchanged()
