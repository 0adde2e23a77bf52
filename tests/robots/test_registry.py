from importlib.metadata import EntryPoint

import numpy as np
import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, GOAL, STATE
from astra_data.robots.registry import TASK_GROUP, TASKS, known_names, known_tasks, place_of, task_named
from astra_data.worlds import user_code
from astra_data.worlds.plane.mazes import FreeSpace
from astra_data.worlds.task import Task
from astra_data.worlds.variation import VariedSimulator


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_worlds_and_columns_fit_together(task: Task) -> None:
    assert TASKS[task.name] is task
    assert task.fps * task.timestep_s == pytest.approx(1.0, abs=0.05)
    sizes = {column.name: column.size for column in task.state_columns}
    env = task.target(2, seed=0, num_threads=1)
    observation = env.reset()
    assert env.state.shape == (2, sizes[STATE])
    assert env.step(torch.zeros(2, sizes[ACTION])).observation.shape == observation.shape
    assert sizes[ACTION] == env.action_size == task.objective.action_size
    assert sizes.get(GOAL, 0) == env.goal.shape[1] == task.objective.goal_size
    abstract = task.abstraction(env.state)
    entries = [entry for group in task.quantities.values() for entry in group]
    assert set(entries) <= set(range(task.abstract_state.size)) and len(entries) == len(set(entries))
    simulator = task.simulator(2)
    assert abstract.shape == simulator.state.shape == (2, task.abstract_state.size)
    assert simulator.parameters["timestep_s"] == task.timestep_s
    started = torch.from_numpy(task.objective.draw_starts(np.random.default_rng(0), 2))
    assert started.shape == abstract.shape


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_simulators_vary(task: Task) -> None:
    state, action = task.simulator(3).state, torch.full((3, task.objective.action_size), 0.5)
    landed = []
    for variation in (task.varied.randomized, task.varied.wide, type(task.varied.wide)()):
        torch.manual_seed(0)
        simulator = task.varied_simulator(3, variation)
        assert isinstance(simulator, VariedSimulator)
        simulator.reset_to(state)
        landed.append(simulator.step(action).clone())
    assert len(landed[0].unique(dim=0)) == len(landed[1].unique(dim=0)) == 3
    torch.testing.assert_close(landed[2], task.simulator(3).step(action))


IN_A_MAZE = [task for task in TASKS.values() if task.plane is not None]


@pytest.mark.parametrize("task", IN_A_MAZE, ids=lambda task: task.name)
def test_targets_start_in_the_free_space(task: Task) -> None:
    env = task.target(2, seed=0, num_threads=1)
    env.reset()
    free = FreeSpace.of_maze(task.maze, radius_m=0.1)
    assert not free.blocked[free.cells(task.abstraction(env.state)[:, :2])].any()


@pytest.mark.parametrize("task", IN_A_MAZE, ids=lambda task: task.name)
def test_the_horizon_leaves_time_to_walk(task: Task) -> None:
    maze = task.maze
    start = maze.fine_index(np.array(maze.cell_center(*maze.start)))
    meters = maze.distance_field(np.array(maze.cell_center(*maze.goal)))[start]
    # Below the largest command along one axis, 1 m/s, with time to spare.
    assert meters / (task.objective.horizon * task.timestep_s) < 0.8


def test_a_task_of_the_package_comes_before_an_installed_one_of_its_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = ("rail-cart", "antmaze-umaze")
    points = [EntryPoint(name, "small_cart:TASK", TASK_GROUP) for name in names]
    monkeypatch.setattr(user_code, "entry_points", lambda group: points)
    assert known_names() == (*TASKS, "rail-cart")
    assert known_tasks()["antmaze-umaze"] is TASKS["antmaze-umaze"]
    assert place_of("rail-cart") == place_of("small_cart:TASK") == "small_cart:TASK"
    assert place_of("antmaze-umaze") == "antmaze-umaze" and place_of("unknown") == "unknown"


def test_an_unknown_task_answers_with_the_known_ones() -> None:
    with pytest.raises(BadInputError, match=r"unknown task 'antmaze-umase'.*antmaze-umaze"):
        task_named("antmaze-umase")


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_task_in_a_maze_has_an_objective_there(task: Task) -> None:
    assert (task.objective.layout is None) == (task.plane is None)
