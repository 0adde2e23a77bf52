"""AntMaze: Gymnasium's ant in a maze, and a planar point mass as its abstract simulator (Section V-A)."""

from functools import partial

from astra_data.dataset.columns import ABSTRACT_STATE, ACTION, GOAL, STATE
from astra_data.robots.ant.abstraction import ant_beyond_point_mass, ant_to_point_mass
from astra_data.robots.ant.body import INTEGRATOR, TIMESTEP_S, WALL_REACH_M
from astra_data.robots.ant.target import AntMazeEnv
from astra_data.worlds.column_entries import PLANAR_GOAL, PLANAR_STATE, ColumnEntry, column, free_body
from astra_data.worlds.plane.mazes import LONG_MAZE, U_MAZE, Maze
from astra_data.worlds.plane.navigation import Navigation
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.plane.states import VariedPlanar
from astra_data.worlds.task import Plane, Task, Varied
from astra_data.worlds.variation import RANDOMIZED_ACTIONS, WIDE_RANGES

_JOINTS = tuple(f"{joint}_{leg}" for leg in range(1, 5) for joint in ("hip", "ankle"))
_COMMAND = (
    ColumnEntry("command_vx", "m/s", "world", "vector"),
    ColumnEntry("command_vy", "m/s", "world", "vector"),
)


def _antmaze(name: str, maze: Maze, horizon: int) -> Task:
    return Task(
        name=name,
        instruction="walk through the maze to the goal",
        objective=Navigation(maze, horizon=horizon),
        make_target=AntMazeEnv,
        make_simulator=partial(PointMass, maze, timestep_s=TIMESTEP_S),
        abstraction=ant_to_point_mass,
        beyond=ant_beyond_point_mass,
        state=column(STATE, free_body(_JOINTS), "qpos (15) and qvel (14) of the ant"),
        goal=column(GOAL, PLANAR_GOAL, "where to go"),
        action=column(ACTION, _COMMAND, "commanded planar velocity, ±1 m/s per axis"),
        commands={"vx": (-1.0, 1.0), "vy": (-1.0, 1.0)},
        abstract_state=column(ABSTRACT_STATE, PLANAR_STATE, "abstract state of the target before the action"),
        quantities={"position_m": (0, 1), "velocity_m_s": (2, 3)},
        timestep_s=TIMESTEP_S,
        simulator_id="point_mass",
        facts={"integrator": INTEGRATOR, "leg_scale": 1.0},
        varied=Varied(VariedPlanar, RANDOMIZED_ACTIONS, WIDE_RANGES),
        plane=Plane(wall_reach_m=WALL_REACH_M),
    )


ANTMAZE_TASKS = (_antmaze("antmaze-umaze", U_MAZE, 700), _antmaze("antmaze-long", LONG_MAZE, 1000))
