"""An arm of gymnasium-robotics, named by its id: collected in, and a policy tested there."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from quick_runs import fit_quickly, run_here, small_tables

from astra_data.reports.artifacts import EVALUATION, Evaluation, read_json
from astra_data.robots.registry import task_named
from astra_data.worlds.user_code import user_object
from astra_data.worlds.walk_through import check_task

FETCH = Path(__file__).parents[2] / "recipes/examples/fetch"
SMALL = """
task = "reach.py:TASK"
methods = ["nas"]
seeds = [0]
[collect]
episodes = 3
max_steps = 12
hold_s = [0.1, 0.5]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The artifacts of a small recipe beside the arm's code."""
    made = tmp_path_factory.mktemp("fetch")
    for file in FETCH.glob("*.py"):
        shutil.copy(file, made)
    (made / "reach.toml").write_text(SMALL + small_tables(held_out_share=0.34, episodes=2))
    with pytest.MonkeyPatch.context() as patch:
        fit_quickly(patch)
        return run_here(made / "reach.toml", until="evaluate")


def test_the_recipe_runs_until_a_policy_is_tested_in_the_arm(folder: Path) -> None:
    evaluation = read_json(Evaluation, folder / "evaluate/nas/seed_0" / EVALUATION)
    assert evaluation.tested_in == "target" and evaluation.target is not None


def test_the_puck_is_pushed_at_one_height_until_it_falls() -> None:
    """In the environment; and in the simulator by what the gripper would overlap."""
    task = task_named(f"{FETCH}/push.py:TASK")
    assert check_task(task) == [] and task.robot is not None
    robot = task.robot()
    robot.reset(seed=0)  # type: ignore[call-arg]
    for _ in range(60):
        state, failed = robot.step(np.array([0.0, 0.0]))
    assert state[2] == pytest.approx(0.425, abs=0.01) and not failed
    simulator = task.simulator(1)
    simulator.reset_to(torch.tensor([[0.0, 0.0, 0.08, 0.0]]))
    assert simulator.step(torch.tensor([[1.0, 0.0]]))[0].tolist() == pytest.approx([0.05, 0.0, 0.095, 0.0])


def test_the_script_pushes_the_puck_to_its_goal() -> None:
    task, method = task_named(f"{FETCH}/push.py:TASK"), user_object(f"{FETCH}/script.py:METHOD")
    env, script = task.target(4, seed=3, num_threads=1), method.learn.learn(None, None)
    assert script.from_file(*script.to_file()).act(np.ones((1, 4))).shape == (1, 2)
    env.reset()
    arrived = torch.zeros(4, dtype=torch.bool)
    for _ in range(task.objective.horizon):
        observation = task.objective.observe(task.abstraction(env.state), env.goal)
        step = env.step(torch.from_numpy(script.act(observation.numpy())), ~arrived)
        arrived |= step.success
    assert arrived.all() and method.role == "ceiling"
