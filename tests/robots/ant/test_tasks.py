import mujoco
import numpy as np
import pytest
import torch

from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, STATE
from astra_data.robots.ant.body import ant_model
from astra_data.robots.ant.tasks import ANTMAZE_TASKS
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.mazes import LONG_MAZE, U_MAZE
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.task import Task

TASK = TASKS["antmaze-umaze"]


def test_each_task_has_its_maze_and_horizon() -> None:
    assert [(task.name, task.maze, task.objective.horizon) for task in ANTMAZE_TASKS] == [
        ("antmaze-umaze", U_MAZE, 700),
        ("antmaze-long", LONG_MAZE, 1000),
    ]


def test_states_are_named_as_mujoco_orders_them() -> None:
    model = ant_model()
    columns = {column.name: column for column in TASK.state_columns}
    joints = [model.joint(joint).name for joint in range(1, model.njnt)]
    expected = ("x", "y", "z", "qw", "qx", "qy", "qz", *joints)
    rates = ("vx", "vy", "vz", "wx", "wy", "wz", *(f"{joint}_rate" for joint in joints))
    assert columns[STATE].names == columns[NEXT_STATE].names == (*expected, *rates)
    assert columns[STATE].size == model.nq + model.nv
    assert (columns[GOAL].size, columns[ACTION].size) == (2, 2)
    data = mujoco.MjData(model)
    data.qvel[3:6] = [0.0, 0.0, 1.0]
    data.qpos[3:7] = [0.5**0.5, 0.5**0.5, 0.0, 0.0]  # rolled by 90 degrees: its z axis points along -y
    mujoco.mj_forward(model, data)
    world = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, world, 0)
    np.testing.assert_allclose(world[:3], [0.0, -1.0, 0.0], atol=1e-12)
    # So the angular velocity is told in the body's frame, as the column says.
    words = columns[STATE].astra or {}
    assert words["frame"][18:21] == ["body"] * 3 and words["frame"][15:18] == ["world"] * 3


def test_the_point_mass_is_as_fast_as_the_longest_command() -> None:
    assert TASK.simulator(1).parameters == {"timestep_s": 0.05, "radius_m": 0.1, "speed_m_s": 1.0}
    assert TASK.abstract_state.names == ("x", "y", "vx", "vy")
    assert {name: list(group) for name, group in TASK.quantities.items()} == {
        "position_m": [0, 1],
        "velocity_m_s": [2, 3],
    }
    assert TASK.planar.wall_reach_m == 1.3


@pytest.mark.parametrize("task", ANTMAZE_TASKS, ids=lambda task: task.name)
def test_point_masses_stand_among_the_walls_of_their_own_maze(task: Task) -> None:
    simulator = task.simulator(1)
    assert isinstance(simulator, PointMass)
    walls = [task.maze.cell_center(*cell) for cell in task.maze.wall_cells()]
    for centers, blocked in ((task.maze.free_centers(), False), (walls, True)):
        cells = simulator.free.cells(torch.tensor(np.array(centers), dtype=torch.float32))
        assert (simulator.free.blocked[cells] == blocked).all()
