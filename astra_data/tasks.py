"""TASKS: each a target environment, an abstract simulator, the map between them, and what to achieve."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, get_args

from torch import Tensor

from astra_data.abstraction import ant_beyond_point_mass, ant_to_point_mass
from astra_data.ant import TIMESTEP_S, WALL_REACH_M
from astra_data.batched import TargetEnv
from astra_data.columns import ABSTRACT_STATE, ACTION, GOAL, NEXT_STATE, STATE, Column
from astra_data.envs.antmaze import AntMazeEnv
from astra_data.errors import BadInputError
from astra_data.mazes import LONG_MAZE, U_MAZE, Maze
from astra_data.navigation import Navigation, RewardKind
from astra_data.objective import Objective
from astra_data.recipe import did_you_mean
from astra_data.sims.point_mass import PointMass
from astra_data.sims.varied_point_mass import VariedPointMass
from astra_data.variation import Variation


@dataclass(frozen=True)
class Task:
    """A problem of abstract sim2real.

    Attributes:
        name: in recipes. instruction: what LeRobot calls the task.
        objective: maze, horizon, reward and success.
        abstraction: φ, target states (..., S) to abstract states (..., X).
        beyond: what φ drops of target states, scaled to a length of about one, (..., S) to (..., S - X).
        state_columns: the columns that hold states, goal and action, with units, frames and roles.
        abstract_state: the column of abstract states, likewise.
        timestep_s: the control period.
        action_limit: largest action along each axis; both worlds cut off what is beyond.
        wall_reach_m: a robot whose clearance in the maze is larger than this touches no wall.
        is_mirrorable: whether the robot, its controller included, is its own mirror image.
        simulator_id: names the abstract simulator in datasets.
    """

    name: str
    instruction: str
    objective: Objective
    abstraction: Callable[[Any], Any]
    beyond: Callable[[Tensor], Tensor]
    state_columns: tuple[Column, ...]
    abstract_state: Column
    timestep_s: float
    action_limit: float
    wall_reach_m: float
    is_mirrorable: bool
    simulator_id: str = "point_mass"

    @property
    def maze(self) -> Maze:
        """The maze."""
        return self.objective.maze

    @property
    def fps(self) -> int:
        """Control steps per second."""
        return round(1.0 / self.timestep_s)

    def target(self, num_envs: int, **options: Any) -> TargetEnv:  # noqa: ANN401 - handed on
        """Build `num_envs` target environments; `options` as for `AntMazeEnv`."""
        return AntMazeEnv(self.objective, num_envs, **options)

    def simulator(self, num_envs: int, device: str = "cpu") -> PointMass:
        """Build `num_envs` abstract simulators."""
        return PointMass(self.maze, num_envs, timestep_s=self.timestep_s, device=device)

    def varied_simulator(self, num_envs: int, variation: Variation, device: str = "cpu") -> VariedPointMass:
        """Build `num_envs` abstract simulators whose parameters vary."""
        return VariedPointMass(self.maze, num_envs, variation, timestep_s=self.timestep_s, device=device)


def _roles(
    names: tuple[str, ...],
    units: list[str],
    frames: list[str],
    roles: list[str],
    mirror: list[str] | None = None,
) -> dict[str, Any]:
    astra = {"unit": units, "frame": frames, "role": roles}
    return {"names": names, "astra": astra if mirror is None else {**astra, "mirror": mirror}}


_JOINTS = tuple(f"{joint}_{leg}" for leg in range(1, 5) for joint in ("hip", "ankle"))
# Left and right swap: legs 1 (front left) and 4, legs 2 (back left) and 3. The hips' axes are vertical, so
# they turn the other way; the ankles' axes are each other's mirror image.
_MIRRORED_JOINTS = [joint for leg in (4, 3, 2, 1) for joint in (f"-hip_{leg}", f"ankle_{leg}")]
_ANT_STATE = _roles(
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
_GOAL = _roles(("goal_x", "goal_y"), ["m"] * 2, ["world"] * 2, ["position"] * 2)
_COMMAND = _roles(("command_vx", "command_vy"), ["m/s"] * 2, ["world"] * 2, ["vector"] * 2)
_ANT_COLUMNS = (
    Column(STATE, size=29, meaning="qpos (15) and qvel (14) of the ant", **_ANT_STATE),
    Column(GOAL, size=2, meaning="where to go", **_GOAL),
    Column(ACTION, size=2, meaning="commanded planar velocity, ±1 m/s per axis", **_COMMAND),
    Column(NEXT_STATE, size=29, meaning="qpos and qvel one control step later", **_ANT_STATE),
)


_POINT_MASS = Column(
    ABSTRACT_STATE,
    size=4,
    meaning="abstract state of the target before the action",
    **_roles(
        ("x", "y", "vx", "vy"),
        ["m"] * 2 + ["m/s"] * 2,
        ["world"] * 4,
        ["position"] * 2 + ["vector"] * 2,
    ),
)


def _antmaze(name: str, maze: Maze, horizon: int, reward: RewardKind) -> Task:
    return Task(
        name=name if reward == "geodesic" else f"{name}-{reward}",
        instruction="walk through the maze to the goal",
        objective=Navigation(maze, horizon, reward),
        abstraction=ant_to_point_mass,
        beyond=ant_beyond_point_mass,
        state_columns=_ANT_COLUMNS,
        abstract_state=_POINT_MASS,
        timestep_s=TIMESTEP_S,
        action_limit=1.0,
        wall_reach_m=WALL_REACH_M,
        # The body is its own mirror image, the learned low-level controller is not.
        is_mirrorable=False,
    )


_MAZES: tuple[tuple[str, Maze, int], ...] = (
    ("antmaze-umaze", U_MAZE, 700),
    ("antmaze-long", LONG_MAZE, 1000),
)

TASKS: dict[str, Task] = {
    task.name: task
    for task in (_antmaze(*maze, reward) for maze in _MAZES for reward in get_args(RewardKind))
}
"""By name. A maze's plain name has the reward of progress along its corridors; `-euclidean` and `-sparse`
follow the name of the same task with another reward."""


def task_named(name: str) -> Task:
    """Return a task.

    Raises:
        BadInputError: there is no such task.
    """
    if name not in TASKS:
        raise BadInputError(f"unknown task '{name}'{did_you_mean(name, TASKS)}")
    return TASKS[name]
