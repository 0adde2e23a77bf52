"""AntMaze: Gymnasium's ant in a maze, and a planar point mass as its abstract simulator (Section V-A)."""

from functools import partial
from typing import get_args

from astra_data.dataset.columns import ABSTRACT_STATE, ACTION, GOAL, STATE, Column
from astra_data.worlds.ant.abstraction import ant_beyond_point_mass, ant_to_point_mass
from astra_data.worlds.ant.body import INTEGRATOR, TIMESTEP_S, WALL_REACH_M
from astra_data.worlds.ant.target import AntMazeEnv
from astra_data.worlds.plane.mazes import LONG_MAZE, U_MAZE, Maze
from astra_data.worlds.plane.navigation import Navigation, RewardKind
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.plane.states import VariedPlanar
from astra_data.worlds.task import Plane, Task, Varied, roles
from astra_data.worlds.variation import RANDOMIZED_ACTIONS, WIDE_RANGES

_JOINTS = tuple(f"{joint}_{leg}" for leg in range(1, 5) for joint in ("hip", "ankle"))
# Left and right swap: legs 1 (front left) and 4, legs 2 (back left) and 3. The hips' axes are vertical, so
# they turn the other way; the ankles' axes are each other's mirror image.
_MIRRORED_JOINTS = [joint for leg in (4, 3, 2, 1) for joint in (f"-hip_{leg}", f"ankle_{leg}")]
_ANT_STATE = roles(
    (
        *("x", "y", "z", "qw", "qx", "qy", "qz", *_JOINTS),
        *("vx", "vy", "vz", "wx", "wy", "wz", *(f"{joint}_rate" for joint in _JOINTS)),
    ),
    ["m"] * 3 + ["1"] * 4 + ["rad"] * 8 + ["m/s"] * 3 + ["rad/s"] * 11,
    ["world"] * 7 + ["joint"] * 8 + ["world"] * 3 + ["body"] * 3 + ["joint"] * 8,
    ["position"] * 2
    + ["invariant"]
    + ["quaternion"] * 4
    + ["invariant"] * 8
    + ["vector"] * 2
    + ["invariant"] * 12,
    [""] * 2
    + ["z"]
    + [""] * 4
    + _MIRRORED_JOINTS
    + [""] * 2
    + ["vz", "-wx", "wy", "-wz"]
    + [f"{joint}_rate" for joint in _MIRRORED_JOINTS],
)
_GOAL = roles(("goal_x", "goal_y"), ["m"] * 2, ["world"] * 2, ["position"] * 2)
_COMMAND = roles(("command_vx", "command_vy"), ["m/s"] * 2, ["world"] * 2, ["vector"] * 2)

_POINT_MASS = Column(
    ABSTRACT_STATE,
    size=4,
    meaning="abstract state of the target before the action",
    **roles(
        ("x", "y", "vx", "vy"), ["m"] * 2 + ["m/s"] * 2, ["world"] * 4, ["position"] * 2 + ["vector"] * 2
    ),
)


def _antmaze(name: str, maze: Maze, horizon: int, reward: RewardKind) -> Task:
    return Task(
        name=name if reward == "geodesic" else f"{name}-{reward}",
        instruction="walk through the maze to the goal",
        objective=Navigation(maze, reward, horizon=horizon),
        make_target=AntMazeEnv,
        make_simulator=partial(PointMass, maze, timestep_s=TIMESTEP_S),
        abstraction=ant_to_point_mass,
        beyond=ant_beyond_point_mass,
        state=Column(STATE, size=29, meaning="qpos (15) and qvel (14) of the ant", **_ANT_STATE),
        goal=Column(GOAL, size=2, meaning="where to go", **_GOAL),
        action=Column(ACTION, size=2, meaning="commanded planar velocity, ±1 m/s per axis", **_COMMAND),
        commands={"vx": (-1.0, 1.0), "vy": (-1.0, 1.0)},
        abstract_state=_POINT_MASS,
        quantities={"position_m": (0, 1), "velocity_m_s": (2, 3)},
        timestep_s=TIMESTEP_S,
        simulator_id="point_mass",
        facts={"integrator": INTEGRATOR, "leg_scale": 1.0},
        varied=Varied(VariedPlanar, RANDOMIZED_ACTIONS, WIDE_RANGES),
        plane=Plane(wall_reach_m=WALL_REACH_M),
    )


_MAZES: tuple[tuple[str, Maze, int], ...] = (
    ("antmaze-umaze", U_MAZE, 700),
    ("antmaze-long", LONG_MAZE, 1000),
)

ANTMAZE_TASKS = tuple(_antmaze(*maze, reward) for maze in _MAZES for reward in get_args(RewardKind))
"""A maze's plain name has the reward of progress along its corridors; `-euclidean` and `-sparse` follow the
name of the same task with another reward."""
