from dataclasses import replace

import numpy as np
import pytest
import torch

from astra_data.errors import BadInputError
from astra_data.free_space import FreeSpace
from astra_data.objective import PlanarObjective
from astra_data.task import Task
from astra_data.tasks import TASKS, task_named
from astra_data.variation import RANDOMIZED_ACTIONS


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_worlds_and_columns_fit_together(task: Task) -> None:
    assert TASKS[task.name] is task
    assert task.fps * task.timestep_s == pytest.approx(1.0, abs=0.05)
    sizes = [column.size for column in task.state_columns]
    env = task.target(2, seed=0, num_threads=1)
    observation = env.reset()
    assert observation.shape == (2, sizes[0] + sizes[1])
    assert env.step(observation[:, :2] * 0).observation.shape == observation.shape
    assert sizes[2] == env.action_size == task.objective.action_size
    assert sizes[1] == task.objective.goal_size
    abstract = task.abstraction(env.state)
    entries = [entry for group in task.quantities.values() for entry in group]
    assert set(entries) <= set(range(task.abstract_state.size)) and len(entries) == len(set(entries))
    simulator = task.simulator(2)
    assert abstract.shape == simulator.state.shape == (2, task.abstract_state.size)
    assert simulator.parameters["timestep_s"] == task.timestep_s
    free = FreeSpace.of_maze(task.maze, radius_m=0.1)
    assert not free.blocked[free.cells(abstract[:, :2])].any()


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_horizon_leaves_time_to_walk(task: Task) -> None:
    maze = task.maze
    start = maze.fine_index(np.array(maze.cell_centre(*maze.start)))
    metres = maze.distance_field(np.array(maze.cell_centre(*maze.goal)))[start]
    # Below the largest command along one axis, 1 m/s, with time to spare.
    assert metres / (task.objective.horizon * task.timestep_s) < 0.8


def test_an_unknown_task_answers_with_the_known_ones() -> None:
    with pytest.raises(BadInputError, match=r"unknown task 'antmaze-umase'.*antmaze-umaze"):
        task_named("antmaze-umase")


def test_who_asks_for_a_maze_where_there_is_none_is_told() -> None:
    nowhere = replace(TASKS["antmaze-umaze"], plane=None)
    with pytest.raises(BadInputError, match=r"a task in a maze, got 'antmaze-umaze'.*leave out"):
        nowhere.varied_simulator(1, RANDOMIZED_ACTIONS)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_task_in_a_maze_has_an_objective_there(task: Task) -> None:
    assert isinstance(task.objective, PlanarObjective) == (task.plane is not None)


@pytest.mark.parametrize(("name", "metres"), [("-sparse", 0.0), ("-euclidean", 0.5), ("", 0.14)])
def test_names_tell_rewards_apart(name: str, metres: float) -> None:
    task = TASKS[f"antmaze-umaze{name}"]
    start = torch.tensor([task.maze.cell_centre(*task.maze.start)])
    goal = torch.tensor([task.maze.cell_centre(*task.maze.goal)])
    # Half a metre straight at the goal, which is behind a wall: the path round the wall's corner, 6 m to the
    # right of the start and 2 m down, is sqrt(6² + 2²) - sqrt(6² + 1.5²) metres shorter.
    after = start + torch.tensor([[0.0, -0.5]])
    reward = task.objective.reward(start, after, goal, torch.zeros(1))
    assert float(reward) == pytest.approx(metres, abs=0.04)
