import shutil
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, Column, Episode
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter
from astra_data.robots import registry
from astra_data.worlds import user_code

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
    assert all(f"│ {task} " in narrow for task in registry.TASKS)
    assert max(map(len, narrow.splitlines()[:-1])) <= 80
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
    monkeypatch.chdir(tmp_path)
    shutil.copy(CART, tmp_path)  # a file of the user's imports those beside it
    (tmp_path / "wrong.py").write_text(WRONG)
    told = "objective.reward(before, after, goal, failed): expected shape (3,), got (3, 1)"
    result = CliRunner().invoke(app, ["check", "wrong.py:TASK"])
    assert result.exit_code == 1
    assert str(result.exception) == f"task wrong.py:TASK: {told}"
    (tmp_path / "wrong.toml").write_text(
        'task = "wrong.py:TASK"\nmethods = ["nas"]\nseeds = [0]\n' + SETTINGS
    )
    result = CliRunner().invoke(app, ["check", "wrong.toml"])
    assert result.exit_code == 1
    assert str(result.exception).startswith("wrong.toml: task ") and str(result.exception).endswith(told)


def test_a_log_is_labeled_by_a_task_in_a_file(tmp_path: Path) -> None:
    state = np.column_stack([0.1 * np.arange(6), np.ones(6)]).astype(np.float32)
    columns = [Column(STATE, size=2), Column(ACTION), Column(NEXT_STATE, size=2)]
    about: dict[str, Any] = {"fps": 10, "task": "drive", "description": {"name": "logs", "stage": "import"}}
    with DatasetWriter(tmp_path / "logs", columns, **about) as writer:
        writer.add(
            Episode(0, {STATE: state[:-1], ACTION: np.ones(5, np.float32), NEXT_STATE: state[1:].copy()})
        )
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
