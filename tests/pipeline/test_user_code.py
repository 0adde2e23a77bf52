"""Artifacts that were made with other code of the user's."""

import shutil
import sys
from pathlib import Path

import pytest
from fake_stages import FakeStages
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.naming import CODE
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.grounded_env import grounded
from astra_data.pipeline.recipe import check_unchanged
from astra_data.pipeline.run import check, run
from astra_data.pipeline.trained_policy import load_policy, settings_of
from astra_data.robots import registry

ROWS = ("ground", "train", "evaluate")
ROOT = Path(__file__).parents[2]
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
    experiment = load_experiment(folder / recipe, folder / "runs")
    found = {key.rpartition("/")[0]: experiment.outdated(key) for key in experiment.items}
    return {key: why.partition(" since")[0] for key, why in found.items() if why}


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
    assert outdated(made) == dict.fromkeys(
        [f"{stage}/mine" for stage in ROWS], "mine (memory: 32, now 9) changed in the recipe"
    )


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
