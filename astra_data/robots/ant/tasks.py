"""The ant: its MuJoCo model, its low-level controller of velocities, its environment in a maze, its tasks."""

import xml.etree.ElementTree as ElementTree
from functools import partial
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats
from astra_data.core.checkpoint import load_tensors
from astra_data.core.lazy import Tensor, mujoco, torch
from astra_data.dataset.columns import ABSTRACT_STATE, ACTION, GOAL, STATE
from astra_data.worlds.geometry import rotation_matrix
from astra_data.worlds.plane.mazes import LONG_MAZE, U_MAZE, Maze
from astra_data.worlds.plane.navigation import Navigation, PlanarObjective, PlanarTarget, PointMass, VariedPlanar
from astra_data.worlds.protocols import Step, rows_in
from astra_data.worlds.simulators import BatchedPhysics, PhysicsTarget, add_walls, wall_geoms
from astra_data.worlds.task import PLANAR_GOAL, PLANAR_STATE, Task, Varied, column, entries, free_body
from astra_data.worlds.variation import RANDOMIZED_ACTIONS, WIDE_RANGES

STATE_SIZE = 29  # qpos (15): x, y, z, quaternion, 8 joint angles; qvel (14): linear, angular, 8 joint rates
CONTROL_SUBSTEPS = 5  # physics steps per control step: 5 x 0.01 s = 20 Hz, as in Gymnasium
TIMESTEP_S = 0.05
INTEGRATOR = "RK4"  # Gymnasium's; "Euler" is 3.7 times faster, but has other contact dynamics
TOPPLE_COSINE = 0.2  # the ant has toppled when the cosine between its up axis and the vertical falls below this
STANDING = (0.0, 0.0, 0.75, 1.0, *[0.0] * 4, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0, *[0.0] * 14)
"""The state of an ant that stands upright at the origin, legs within their joint limits."""
WALL_REACH_M = 1.3
"""With more clearance than this on the maze's grid the ant touches no wall: a stretched leg ends 1.21 m from
the torso's center, and the grid is up to 0.1 m off."""
WALL_HEIGHT = 0.5  # in units of the maze scale, as in gymnasium-robotics
# Ankle axes alternate; these signs make every leg look like leg 1 (angle 30..70 degrees).
_ANKLE_SIGNS = np.array([1.0, -1.0, -1.0, 1.0])


def ant_model(maze: Maze | None = None, *, leg_scale: float = 1.0) -> "mujoco.MjModel":
    """Build Gymnasium's ant, in a `maze` as gymnasium-robotics has it or on a plane; `leg_scale` lengthens its legs."""
    root = ElementTree.parse(Path(str(files("gymnasium.envs.mujoco") / "assets" / "ant.xml"))).getroot()
    root.findall("option")[0].set("integrator", INTEGRATOR)
    world = root.findall("worldbody")[0]
    torso = world.findall("body")[0]
    for part in [*torso.iter("geom"), *torso.iterfind(".//body")] if leg_scale != 1.0 else []:
        for length in {"fromto", "pos"} & {*part.attrib}:
            scaled = [str(float(value) * leg_scale) for value in part.attrib[length].split()]
            part.set(length, " ".join(scaled))
    if maze is not None:
        look = {"material": "", "contype": "1", "conaffinity": "1", "rgba": "0.7 0.5 0.3 1.0"}
        add_walls(world, maze, WALL_HEIGHT * maze.scale, **look)
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))


def canonical_view(qpos: Floats, qvel: Floats, command: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return body and command (B, 2) in the heading frame (B, 28), turned by quarters (B,) toward the command."""
    rotation = rotation_matrix(qpos[:, 3:7])
    yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    bearing = np.arctan2(command[:, 1], command[:, 0]) - yaw
    quarters = np.round(bearing / (np.pi / 2)).astype(np.intp) % 4
    frame = yaw + quarters * (np.pi / 2)
    cos, sin = np.cos(frame), np.sin(frame)

    def in_frame(vector: Floats) -> Floats:
        turned = vector.copy()
        turned[:, 0] = cos * vector[:, 0] + sin * vector[:, 1]
        turned[:, 1] = cos * vector[:, 1] - sin * vector[:, 0]
        return turned

    legs = (np.arange(4) + quarters[:, None]) % 4
    signs = _ANKLE_SIGNS[legs]
    batch = np.arange(len(qpos))[:, None]
    angles, rates = qpos[:, 7:].reshape(-1, 4, 2), qvel[:, 6:].reshape(-1, 4, 2)
    angular = np.einsum("bij,bj->bi", rotation, qvel[:, 3:6])
    body = [qpos[:, 2:3] - 0.6, *map(in_frame, (rotation[:, :, 2], qvel[:, 0:3], angular))]
    joints = [angles[batch, legs, 0], angles[batch, legs, 1] * signs]
    joints += [rates[batch, legs, 0] * 0.2, rates[batch, legs, 1] * signs * 0.2]
    return np.concatenate([*body, *joints, in_frame(command)], axis=1), quarters


def torques_to_body(torques: Floats, quarters: NDArray[np.intp]) -> Floats:
    """Turn canonical torques (B, 8), hips then ankles, into the model's control vector (B, 8)."""
    legs = (np.arange(4) - quarters[:, None]) % 4
    batch = np.arange(len(torques))[:, None]
    hips = torques[:, :4][batch, legs]
    ankles = torques[:, 4:][batch, legs] * _ANKLE_SIGNS
    body = np.stack([hips, ankles], axis=-1)
    return np.roll(body, 1, axis=1).reshape(-1, 8)  # the model lists its actuators from leg 4, then 1, 2, 3


class VelocityController:
    """The frozen low-level controller, a ReLU network: world-frame planar velocity command in, joint torques out."""

    def __init__(self) -> None:
        """Load the checkpoint shipped with the package."""
        source = Path(str(files("astra_data.robots.ant") / "velocity_controller.safetensors"))
        tensors, _ = load_tensors(source)
        self._layers = [(tensors[f"{layer}.weight"], tensors[f"{layer}.bias"]) for layer in range(len(tensors) // 2)]
        self._torque_scale = float(tensors["torque_scale"])

    def __call__(self, qpos: Floats, qvel: Floats, command: Floats) -> Floats:
        """Return torques (B, 8) in [-1, 1] for `qpos` (B, 15), `qvel` (B, 14) and `command` (B, 2) in m/s."""
        observation, quarters = canonical_view(qpos, qvel, command)
        hidden = torch.from_numpy(observation).float()
        for weight, bias in self._layers[:-1]:
            hidden = torch.nn.functional.linear(hidden, weight, bias).relu()
        squashed = torch.nn.functional.linear(hidden, *self._layers[-1]).tanh()
        return torques_to_body(self._torque_scale * squashed.double().numpy(), quarters)


class AntMazeEnv(PhysicsTarget, PlanarTarget):
    """B ants in a maze, states qpos, qvel (B, 29); action: world-frame velocity in m/s, (B, 2), clipped to ±1."""

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
        num_threads: int | None = None,
    ) -> None:
        """Build B ants; `leg_scale` is a factor on the legs' length."""
        super().__init__(objective, num_envs, start_anywhere=start_anywhere)
        self.controller = VelocityController()
        model = ant_model(objective.maze, leg_scale=leg_scale)
        self.physics = BatchedPhysics(
            model, num_envs, substeps=CONTROL_SUBSTEPS, watched_geoms=wall_geoms(model), num_threads=num_threads
        )
        self.reseed(seed)

    @property
    def wall_contact(self) -> Tensor:
        """Which ants touched a wall in their last step, (B,) bool."""
        return torch.from_numpy(self.physics.touching.copy())

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Set the ants in `mask` (B,), by default all, upright at new starts with random headings."""
        rows = rows_in(mask, self.num_envs)
        state = np.tile(STANDING, (len(rows), 1))
        state[:, :2] = self._start(rows)[:, :2]
        yaw = self._rng.uniform(-np.pi, np.pi, len(rows))
        state[:, 3], state[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
        self._aim(rows)
        self.reset_to(rows, state)
        return self._observe()

    def step(self, action: Tensor, active: Tensor | None = None) -> Step:
        """Follow the commands `action` (B, 2) for 0.05 s; rows outside `active` (B,) stay."""
        command = action.clamp(-1.0, 1.0).numpy().astype(np.float64)
        before = self.position
        torques = self.controller(self.physics.qpos, self.physics.qvel, command)
        self.physics.step(torques, None if active is None else active.numpy())
        toppled = rotation_matrix(self.physics.qpos[:, 3:7])[:, 2, 2] < TOPPLE_COSINE
        return self._judged(before, self.position, toppled)


_PLANAR = [0, 1, 15, 16]
_REST = [entry for entry in range(29) if entry not in _PLANAR]
_JOINT_RATES = slice(-8, None)


def ant_to_point_mass[Array: (NDArray[np.float32], Floats, Tensor)](state: Array) -> Array:
    """Keep the torso's planar position in m and velocity in m/s: (..., 29) to [x, y, vx, vy] (..., 4)."""
    return state[..., _PLANAR]


def ant_beyond_point_mass(state: Tensor) -> Tensor:
    """Return what `ant_to_point_mass` drops: (..., 29) to (..., 25), in SI units, but a fifth of the joint rates."""
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
        wall_reach_m=WALL_REACH_M,
    )


UMAZE, LONG = _antmaze("antmaze-umaze", U_MAZE, 700), _antmaze("antmaze-long", LONG_MAZE, 1000)
