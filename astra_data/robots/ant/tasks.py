"""AntMaze: Gymnasium's ant in a maze, and a planar point mass as its abstract simulator (Section V-A)."""

from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.dataset.columns import ABSTRACT_STATE, ACTION, GOAL, STATE
from astra_data.robots.ant.body import (
    CONTROL_SUBSTEPS,
    INTEGRATOR,
    POSITIONS,
    STATE_SIZE,
    TIMESTEP_S,
    TOPPLE_COSINE,
    WALL_REACH_M,
    VelocityController,
    ant_model,
    standing_pose,
    up_cosine,
)
from astra_data.worlds.batched_mujoco import BatchedPhysics, wall_geoms
from astra_data.worlds.plane.mazes import LONG_MAZE, U_MAZE, Maze
from astra_data.worlds.plane.navigation import Navigation, PlanarObjective, PlanarTarget
from astra_data.worlds.plane.point_mass import PointMass, VariedPlanar
from astra_data.worlds.protocols import Step, rows_in
from astra_data.worlds.task import (
    PLANAR_GOAL,
    PLANAR_STATE,
    Plane,
    Task,
    Varied,
    column,
    entries,
    free_body,
)
from astra_data.worlds.variation import RANDOMIZED_ACTIONS, WIDE_RANGES


class AntMazeEnv(PlanarTarget):
    """B ants in a maze; action: world-frame velocity command in m/s, (B, 2), clipped to ±1 per axis.

    State (B, 29): qpos (15) then qvel (14), as in Gymnasium. Observation (B, 31): state, then goal (2).
    Reaching the goal and toppling end an episode; wall contacts are recorded, not punished.

    Attributes:
        state: (B, 29) float32. goal: (B, 2) float32. failed: (B,) bool, toppled in the last step.
    """

    observation_size = STATE_SIZE + 2
    action_size = 2

    def __init__(
        self,
        objective: PlanarObjective,
        num_envs: int,
        *,
        seed: int,
        leg_scale: float = 1.0,
        start_anywhere: bool = False,
        controller: VelocityController | None = None,
        num_threads: int | None = None,
    ) -> None:
        """Build B ants.

        leg_scale: factor on the legs' length. controller: the low-level controller, by default the one
        shipped.
        """
        super().__init__(objective, num_envs, start_anywhere=start_anywhere)
        self.leg_scale = leg_scale
        self.controller = controller or VelocityController.load()
        model = ant_model(objective.maze, leg_scale=leg_scale)
        self.physics = BatchedPhysics(
            model,
            num_envs,
            substeps=CONTROL_SUBSTEPS,
            watched_geoms=wall_geoms(model),
            num_threads=num_threads,
        )
        self.reseed(seed)

    @property
    def state(self) -> Tensor:
        """The full target states, (B, 29) float32."""
        return torch.from_numpy(np.concatenate([self.physics.qpos, self.physics.qvel], axis=1)).float()

    @property
    def position(self) -> Tensor:
        """Positions of the ants, (B, 2) float32 in m."""
        return torch.from_numpy(self.physics.qpos[:, :2]).float()

    @property
    def wall_contact(self) -> Tensor:
        """Which ants touched a wall in their last step, (B,) bool."""
        return torch.from_numpy(self.physics.touching.copy())

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Set the ants in `mask` (B,), by default all, upright at new starts with random headings."""
        rows = rows_in(mask, self.num_envs)
        count = len(rows)
        qpos = standing_pose(count)
        qpos[:, :2] = self._start(rows)[:, :2]
        yaw = self._rng.uniform(-np.pi, np.pi, count)
        qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
        self._aim(rows)
        self.reset_to(rows, np.concatenate([qpos, np.zeros((count, STATE_SIZE - POSITIONS))], axis=1))
        return self._observe()

    def reset_to(self, rows: NDArray[np.intp], state: Floats) -> None:
        """Set the ants `rows` (n,) to `state` (n, 29)."""
        self.physics.set_state(rows, state[:, :POSITIONS], state[:, POSITIONS:])
        self.failed[rows] = False

    def state_dict(self) -> dict[str, Tensor]:
        """Return what `load_state_dict` needs to continue from here; later random draws may differ."""
        return {"physics": torch.from_numpy(self.physics.state.copy()), "goal": self.goal.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        self.physics.state[:] = state["physics"].numpy()
        self.goal = state["goal"].clone()

    def step(self, action: Tensor, active: Tensor | None = None) -> Step:
        """Follow the commands `action` (B, 2) for 0.05 s; rows outside `active` (B,) stay."""
        command = action.clamp(-1.0, 1.0).numpy().astype(np.float64)
        before = self.position
        torques = self.controller(self.physics.qpos, self.physics.qvel, command)
        self.physics.step(torques, None if active is None else active.numpy())
        toppled = up_cosine(self.physics.qpos[:, 3:7]) < TOPPLE_COSINE
        return self._judged(before, self.position, toppled)


_PLANAR = [0, 1, 15, 16]
_REST = [entry for entry in range(29) if entry not in _PLANAR]
_JOINT_RATES = slice(-8, None)


def ant_to_point_mass[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep the planar position and velocity of an ant's state: (..., 29) to [x, y, vx, vy] (..., 4).

    Position in m and velocity in m/s, both of the torso in the world frame. Dropped: height, orientation,
    all joints, and every rate but the two planar ones.
    """
    return state[..., _PLANAR]


def ant_beyond_point_mass(state: Tensor) -> Tensor:
    """Return the part of an ant's state that `ant_to_point_mass` drops: (..., 29) to (..., 25).

    In the order of the state and in SI units, but for joint rates, which reach 10 rad/s: a fifth of those.
    """
    rest = state[..., _REST]
    rest[..., _JOINT_RATES] *= 0.2
    return rest


_JOINTS = tuple(f"{joint}_{leg}" for leg in range(1, 5) for joint in ("hip", "ankle"))
_COMMAND = entries("command_vx command_vy", "m/s", "world", "vector")


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


UMAZE, LONG = _antmaze("antmaze-umaze", U_MAZE, 700), _antmaze("antmaze-long", LONG_MAZE, 1000)
