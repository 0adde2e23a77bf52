import shutil
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import call
from fake_dataset import write_fake
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, Column, Episode
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import open_dataset
from astra_data.dataset.writer import DatasetWriter, StagedWriter
from astra_data.pipeline.stages.augment import AugmentConfig
from astra_data.robots import registry
from astra_data.worlds import user_code

pytestmark = pytest.mark.usefixtures("home")

SMALL = ["--episodes", "2", "--max-steps", "3"]


def test_a_dataset_is_collected_and_paired_without_a_recipe(home: Path) -> None:
    collected = call("collect", "antmaze-umaze", *SMALL, "--seed", "3")
    folder = home / "antmaze-umaze-random-seed3/data-1.0.0"
    assert collected.output.splitlines()[-1] == f"finished: {folder}" and "target steps/s" in collected.output
    dataset = Dataset.open(folder)
    assert (len(dataset), dataset.lengths.tolist()) == (2, [3, 3])
    paired = call("pair", "antmaze-umaze-random-seed3", "--simulator", "antmaze-umaze")
    assert paired.output.splitlines()[-1] == f"finished: {folder.with_name('data-2.0.0')}"
    assert open_dataset("antmaze-umaze-random-seed3").description["parents"] == [dataset.identity]


def test_an_option_of_0_is_given(home: Path) -> None:
    call("collect", "antmaze-umaze", *SMALL, "--name", "walks")
    call("pair", "walks", "--simulator", "antmaze-umaze", "--reset-tolerance", "0")
    assert open_dataset("walks").description["config"]["reset_tolerance"] == 0.0


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["collect", "recipe.toml", "--episodes", "3"], r"\[collect\] sets this: leave out --episodes"),
        (["collect", "recipe.toml", "--resume"], r"leave out --resume"),
        (["collect", "antmaze-umaze", "--seed", "1", "--seed", "2"], r"give at most one --seed"),
        (["collect", "antmaze-umaze", "--max-steps", "-1"], r"max_steps: expected greater than"),
        (["collect", "humanoid-walker2d", "--clearance-m", "0.5", "--start", "task"], r"expected a task in a maze"),
        (["pair", "recipe.toml", "--simulator", "antmaze-umaze"], r"\[pair\] sets this: leave out --simulator"),
        (["pair", "walks", "--jobs", "2", "--simulator", "antmaze-umaze"], r"leave out --seed and --jobs"),
        (["pair", "walks"], r"expected --simulator"),
    ],
)
def test_what_does_not_fit_is_told(home: Path, arguments: list[str], told: str) -> None:
    error = call(*arguments).exception
    assert isinstance(error, AstraDataError)
    with pytest.raises(AstraDataError, match=told):
        raise error
    assert not home.exists()


def test_stopping_a_recording_says_how_to_go_on(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add = StagedWriter.add

    def stop(writer: StagedWriter, episode: Episode, position: int | None = None) -> None:
        add(writer, episode, position)
        raise KeyboardInterrupt

    monkeypatch.setattr(StagedWriter, "add", stop)
    stopped = call("collect", "antmaze-umaze", *SMALL)
    assert stopped.exit_code == 130
    assert stopped.output.splitlines()[-1] == "stopped: run the same command with --resume to continue"
    monkeypatch.setattr(StagedWriter, "add", add)
    assert "resume it" in str(call("collect", "antmaze-umaze", *SMALL).exception)
    assert call("collect", "antmaze-umaze", *SMALL, "--resume").exit_code == 0


def test_a_dataset_is_augmented_beside_itself(home: Path) -> None:
    call("collect", "antmaze-umaze", "--episodes", "3", "--max-steps", "6", "--name", "walks")
    options = ["--episodes", "7", "--margin-m", "0.3", "--min-steps", "3", "--rotations", "none", "--seed", "5"]
    result = call("augment", "walks", "--task", "antmaze-umaze", *options)
    assert result.output.splitlines()[-1] == f"finished: {home / 'walks/data-1.1.0'}"
    dataset = open_dataset("walks")
    assert len(dataset) == 7
    assert dataset.description["config"] == AugmentConfig(
        episodes=7, margin_m=0.3, min_steps=3, rotations="none"
    ).model_dump(mode="json")
    assert dataset.description["seeds"]["augment"] == 5


def test_what_cannot_be_augmented_is_told(home: Path, tmp_path: Path) -> None:
    options = ["--rotations", "none", "--no-translations"]
    error = call("augment", str(write_fake(tmp_path / "fake").root), *options).exception
    assert isinstance(error, AstraDataError) and "translations: expected rotations or translations" in str(error)
    assert not home.exists()


CART = Path(__file__).parents[1] / "small_cart.py"


def test_tasks_of_the_package_and_of_installed_ones_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = EntryPoint("rail-cart", "small_cart:LOGS_ALONE", registry.TASK_GROUP)
    monkeypatch.setattr(user_code, "entry_points", lambda group: [offered])
    result = CliRunner().invoke(app, ["list", "--tasks"], env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    lines = {line.split()[1]: line for line in result.output.splitlines() if line.startswith("│")}
    assert set(registry.TASKS) <= set(lines)
    assert "(installed)" in lines["rail-cart"] and "(installed)" not in lines["antmaze-umaze"]
    assert "vx, vy" in lines["antmaze-long"] and " 20 " in lines["antmaze-long"]
    assert "z, pitch, left_hip, left_knee and 11 more" in lines["humanoid-walker2d"]
    assert "no" in lines["rail-cart"].split() and "yes" in lines["antmaze-umaze"].split()
    narrow = CliRunner().invoke(app, ["list", "--tasks"], env={"COLUMNS": "80"}).output
    assert all(f"│ {task} " in narrow for task in registry.TASKS) and max(map(len, narrow.splitlines()[:-1])) <= 80
    assert registry.task_named("rail-cart").name == "rail-cart"
    with pytest.raises(BadInputError, match=r"unknown task 'rail-crat': did you mean 'rail-cart'"):
        registry.task_named("rail-crat")


SETTINGS = """
[collect]
episodes = 1
start = "task"
[ground]
updates = 1
held_out_share = 0.5
[train]
total_steps = 64
"""
WRONG = """
from dataclasses import replace
from small_cart import TASK as RIGHT, Reach
class Wrong(Reach):
    def reward(self, before, after, goal, failed):
        return after - before
TASK = replace(RIGHT, objective=Wrong(horizon=40))
"""


def test_a_task_is_walked_through(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = CliRunner().invoke(app, ["check", f"{CART}:TASK"])
    assert result.exit_code == 0 and "small_cart.py:TASK: found no errors" in result.output
    assert result.output.startswith("commands: v -1…4\nabstract states: x\n")
    assert "name your own task like cart.py:TASK" in str(CliRunner().invoke(app, ["check", f"{CART}"]).exception)
    monkeypatch.chdir(tmp_path)
    shutil.copy(CART, tmp_path)  # a file of the user's imports those beside it
    (tmp_path / "wrong.py").write_text(WRONG)
    told = "objective.reward(before, after, goal, failed): expected shape (3,), got (3, 1)"
    result = CliRunner().invoke(app, ["check", "wrong.py:TASK"])
    assert result.exit_code == 1 and str(result.exception) == f"task wrong.py:TASK: {told}"
    (tmp_path / "wrong.toml").write_text('task = "wrong.py:TASK"\nmethods = ["nas"]\nseeds = [0]\n' + SETTINGS)
    result = CliRunner().invoke(app, ["check", "wrong.toml"])
    assert result.exit_code == 1
    assert str(result.exception).startswith("wrong.toml: task ") and str(result.exception).endswith(told)


def test_a_log_is_labeled_by_a_task_in_a_file(tmp_path: Path) -> None:
    state = np.column_stack([0.1 * np.arange(6), np.ones(6)]).astype(np.float32)
    columns = [Column(STATE, size=2), Column(ACTION), Column(NEXT_STATE, size=2)]
    about: dict[str, Any] = {"fps": 10, "task": "drive", "description": {"name": "logs", "stage": "import"}}
    with DatasetWriter(tmp_path / "logs", columns, **about) as writer:
        writer.add(Episode(0, {STATE: state[:-1], ACTION: np.ones(5, np.float32), NEXT_STATE: state[1:].copy()}))
    goals = []
    for name, more in (("labeled", list[str]()), ("again", ["--seed", "0"]), ("other", ["--seed", "1"])):
        out = f"{tmp_path}/{name}"
        command = ["label", f"{tmp_path}/logs", "--task", f"{CART}:LOGS_ALONE", "--out", out, *more]
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.output
        assert f"finished: {out}" in result.output.replace("\n", "")
        labeled = Dataset.open(out).columns([REWARD, GOAL])
        np.testing.assert_allclose(labeled[REWARD], 0.1, atol=1e-6)
        goals.append(float(labeled[GOAL][0]))
    assert goals[0] == goals[1] != goals[2]
