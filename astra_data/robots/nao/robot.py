"""The NAO's body as a MuJoCo model, and B of them: physics, servos, ankle reflex, 16 ticks per control step."""

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib.resources import files
from math import atan2
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.core.lazy import mujoco
from astra_data.robots.nao import walk
from astra_data.robots.nao.kicking import BALL_RADIUS_M
from astra_data.worlds.geometry import rotation_matrix
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.simulators import BatchedPhysics, add_walls, physics_state, wall_geoms

SUBSTEPS = 3  # physics steps per tick: 4 ms each
WALL_HEIGHT_M = 0.5
TICKS = 16  # per control step
FALLEN_COSINE = 0.7  # a robot has fallen when the cosine between its up axis and the vertical is below this (45°)
MOTORS = len(walk.TO_MOTORS)
_ANKLES = ((4, 5), (10, 11))  # ankles among the motors: pitch, roll; left, right
CONTROL_STEP_S = TICKS * walk.TICK_S
_BALL = 7 + MOTORS
_MIDDLE_M = 0.03  # either foot may kick a ball that is less far to the side: the torso sways as far from step to step


def nao_model(maze: Maze | None = None, *, ball: bool = False) -> "mujoco.MjModel":
    """Build a NAO, see nao.xml; qpos: torso (7), left leg (6), right leg (6), ball (7); controls: the legs' angles."""
    root = ElementTree.parse(Path(str(files("astra_data.robots.nao") / "nao.xml"))).getroot()
    (world,) = root.findall("worldbody")
    for body in [] if ball else world.findall("body[@name='ball']"):
        world.remove(body)
    if maze:
        add_walls(world, maze, WALL_HEIGHT_M, contype="2")
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))


class BatchedBodies(BatchedPhysics):
    """B bodies of one model; one that has fallen stays as it is until its reset."""

    def __init__(
        self, model: "mujoco.MjModel", traits: walk.Traits, *, longest_delay_ticks: int, num_threads: int | None
    ) -> None:
        count = len(traits.stiffness)
        super().__init__(model, count, substeps=SUBSTEPS, num_threads=num_threads)
        self.traits = traits
        self._stiffness = float(model.actuator_gainprm[0, 0])
        self.sent: Floats = np.zeros((count, longest_delay_ticks + TICKS, MOTORS))
        self.tilting: Floats = np.zeros((count, 2))
        self.held: Floats = np.zeros((count, MOTORS))
        self.waited: NDArray[np.intp] = np.zeros(count, dtype=np.intp)
        self.gyro: Floats = np.zeros((count, 3))
        self.pressure: Floats = np.zeros((count, 8))
        self.fallen: Bools = np.zeros(count, dtype=bool)
        self._walls = wall_geoms(model)
        self._robot_geoms = np.zeros(model.ngeom, dtype=bool)
        self._robot_geoms[[model.geom(name).id for name in ("chest", "LFoot", "RFoot")]] = True
        self._models = [copy.copy(model) for _ in self._data]

    def reset(self, rows: NDArray[np.intp], qpos: Floats, angles: Floats) -> None:
        """Set the bodies `rows` (n,) at rest at `qpos` (n, nq), their servos holding `angles` (n, 12)."""
        self.set_state(rows, qpos, np.zeros((len(rows), self.model.nv)))
        self.sent[rows], self.held[rows] = angles[:, None], angles
        for part in (self.waited, self.tilting, self.gyro, self.pressure, self.fallen):
            part[rows] = 0

    def advance(self, rows: NDArray[np.intp], targets: walk.Targets, noise: Floats) -> NDArray[np.intp]:
        """Run `rows` (n,) through one control step; return how many ticks of the targets were followed, (B,) int."""
        self.touching[rows] = False
        rows = rows[~self.fallen[rows]]
        before = self.sent.shape[1] - TICKS
        self.sent[rows, :before] = self.sent[rows, TICKS:]
        followed = np.zeros(len(self.fallen), dtype=np.intp)
        self._share_out(rows.tolist(), partial(self._walk_rows, targets, noise, followed))
        return followed

    def _walk_rows(
        self, targets: walk.Targets, noise: Floats, followed: NDArray[np.intp], thread: int, rows: Iterator[int]
    ) -> None:
        model, data, traits = self._models[thread], self._data[thread], self.traits
        floor = model.geom("floor").id
        for row in rows:
            model.geom_friction[floor, 0] = traits.friction[row]
            stiffness = self._stiffness * traits.stiffness[row]
            model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1] = stiffness, -stiffness
            mujoco.mj_setState(model, data, self.state[row], physics_state())
            followed[row] = self._walk(model, data, row, targets, noise[row])
            mujoco.mj_getState(model, data, self.state[row], physics_state())
            self.pressure[row] = data.sensordata

    def _walk(
        self, model: "mujoco.MjModel", data: "mujoco.MjData", row: int, targets: walk.Targets, noise: Floats
    ) -> int:
        style, sent, rates, step = walk.STYLE, self.sent[row], data.qvel[3:6], mujoco.mj_step
        planned = (targets.angles[row] + self.traits.joint_offset_rad[row])[:, walk.TO_MOTORS]
        supports, lifts_off = targets.supports[row].tolist(), targets.lifts_off[row].tolist()
        first = sent.shape[0] - TICKS
        arrived = first - int(self.traits.delay_ticks[row])
        keep, (pitch_gain, roll_gain) = style.gyro_keep, style.gyro_gain
        roll_rate, pitch_rate = self.tilting[row].tolist()
        held, waited, followed = self.held[row], int(self.waited[row]), 0
        for tick in range(TICKS):
            measured = rates + noise[tick]
            roll_rate = keep * roll_rate + (1 - keep) * float(measured[0])
            pitch_rate = keep * pitch_rate + (1 - keep) * float(measured[1])
            w, x, y, z = data.qpos[3:7].tolist()
            roll = atan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
            # Positive rolls are to the right; leaning over the left foot is negative.
            lean = -(roll + style.lean_ahead_s * roll_rate) * lifts_off[followed]
            if lean > style.lean_rad and waited < style.longest_wait_ticks:
                waited, carries = waited + 1, (True, True)
            else:
                held, carries = planned[followed], supports[followed]
                waited, followed = 0, followed + 1
            sent[first + tick] = held
            for carrying, (ankle_pitch, ankle_roll) in zip(carries, _ANKLES, strict=True):
                if carrying:
                    sent[first + tick, ankle_pitch] += pitch_gain * pitch_rate
                    sent[first + tick, ankle_roll] += roll_gain * roll_rate
            data.ctrl[:] = sent[arrived + tick]
            step(model, data, SUBSTEPS)
            if self._walls is not None and not self.touching[row]:
                self.touching[row] = self._touches(data)
            _, x, y, _ = data.qpos[3:7].tolist()
            if 1 - 2 * (x * x + y * y) < FALLEN_COSINE:
                self.fallen[row] = True
                break
        self.held[row], self.waited[row] = held, waited
        self.tilting[row] = roll_rate, pitch_rate
        self.gyro[row] = measured
        return followed

    def _touches(self, data: "mujoco.MjData") -> bool:
        """Return whether the robot, not the ball, touches a wall."""
        first, last = self._walls or (0, -1)
        geoms = data.contact.geom
        walls = (geoms >= first) & (geoms <= last)
        return bool((walls[:, ::-1] & self._robot_geoms[geoms]).any())


class BatchedNao:
    """B NAOs, each on a floor of its own."""

    def __init__(
        self,
        num_robots: int,
        *,
        seed: int,
        maze: Maze | None = None,
        ball: bool = False,
        spread: walk.TraitSpread | None = None,
        num_threads: int | None = None,
    ) -> None:
        self.num_robots = num_robots
        self.spread = spread or walk.TraitSpread()
        self.has_ball = ball
        self.reseed(seed)
        rng = np.random.default_rng(seed)
        self.traits = walk.Traits.draw(self.spread, num_robots, rng)
        self.gait = walk.Gait.standing(num_robots)
        model, longest = nao_model(maze, ball=ball), self.spread.delay_ticks[1]
        self.bodies = BatchedBodies(model, self.traits, longest_delay_ticks=longest, num_threads=num_threads)
        self.reset(np.arange(num_robots), np.zeros((num_robots, 3)), rng)

    def reset(self, rows: NDArray[np.intp], pose: Floats, rng: np.random.Generator, ball: Floats | None = None) -> None:
        """Set robots upright at `pose` (n, 3), with new traits, and balls at `ball` (n, 2), by default 1 m ahead."""
        walk.put_rows(self.traits, rows, walk.Traits.draw(self.spread, len(rows), rng))
        standing = walk.Gait.standing(len(rows))
        walk.put_rows(self.gait, rows, standing)
        angles = walk.leg_angles(walk.stance(standing))
        x, y, yaw = pose.T
        qpos = np.tile(self.bodies.model.qpos0, (len(rows), 1))
        qpos[:, 0], qpos[:, 1] = x, y
        qpos[:, 2] = walk.STYLE.hip_height_m + walk.HIP_OFFSET_Z_M
        qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
        qpos[:, 7:_BALL] = angles[:, walk.TO_MOTORS]
        if self.has_ball:
            ahead = np.stack([x + np.cos(yaw), y + np.sin(yaw)], axis=1)
            qpos[:, _BALL : _BALL + 2] = ahead if ball is None else ball
            qpos[:, _BALL + 2] = BALL_RADIUS_M
        self.bodies.reset(rows, qpos, (angles + self.traits.joint_offset_rad[rows])[:, walk.TO_MOTORS])

    def step(self, command: Floats, active: Bools | None = None, kick: Bools | None = None) -> None:
        """Walk for 0.192 s at `command` (B, 3), m/s ahead and left, rad/s; who is to `kick` does in its next swing."""
        upright = ~self.bodies.fallen
        rows = np.flatnonzero(upright if active is None else active & upright)
        kicking = self._kicking_feet(kick)
        targets = walk.advance(replace(self.gait), command, self.traits.quality, TICKS, kicking)
        rng, size = np.random.default_rng(self._noise.tolist()), (self.num_robots, TICKS, 3)
        noise = rng.normal(0.0, self.spread.gyro_noise_rad_s, size)
        self._noise[1] += 1
        self.gait = targets.reached(self.bodies.advance(rows, targets, noise))

    def reseed(self, seed: int) -> None:
        """Restart the noise of the sensors at `seed`."""
        self._noise = np.array([seed, 0])  # and the number of steps so far

    def _kicking_feet(self, kick: Bools | None) -> Bools:
        if kick is None or not self.has_ball:
            return np.zeros((self.num_robots, 2), dtype=bool)
        x, y = (self.ball - self.pose[:, :2]).T
        yaw = self.pose[:, 2]
        to_the_left = np.cos(yaw) * y - np.sin(yaw) * x
        sides = np.stack([to_the_left > -_MIDDLE_M, to_the_left < _MIDDLE_M], axis=1)
        return np.asarray(kick[:, None] & sides)

    @property
    def pose(self) -> Floats:
        """True x, y of the torsos in m and their heading in rad, (B, 3)."""
        rotation = rotation_matrix(self.bodies.qpos[:, 3:7])
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        return np.concatenate([self.bodies.qpos[:, :2], yaw[:, None]], axis=1)

    @property
    def velocity(self) -> Floats:
        """True velocity of the torsos on the floor, x, y in m/s, turn in rad/s, (B, 3)."""
        turn = np.einsum("bi,bi->b", rotation_matrix(self.bodies.qpos[:, 3:7])[:, 2], self.bodies.qvel[:, 3:6])
        return np.concatenate([self.bodies.qvel[:, :2], turn[:, None]], axis=1)

    @property
    def ball(self) -> Floats:
        """The balls' true x, y in m, (B, 2)."""
        return self.bodies.qpos[:, _BALL : _BALL + 2]

    @property
    def ball_velocity(self) -> Floats:
        """The balls' true velocity in m/s, (B, 2)."""
        return self.bodies.qvel[:, _BALL - 1 : _BALL + 1]

    @property
    def angles(self) -> Floats:
        """Measured joint angles, (B, 11) in rad (`kinematics.JOINTS`)."""
        return self.bodies.qpos[:, [7, *range(8, 13), *range(14, 19)]] - self.traits.joint_offset_rad

    @property
    def tilt(self) -> Floats:
        """Roll and pitch of the torsos, (B, 2) in rad."""
        up = rotation_matrix(self.bodies.qpos[:, 3:7])[:, 2]
        return np.stack([np.arctan2(up[:, 1], up[:, 2]), np.arcsin(np.clip(-up[:, 0], -1.0, 1.0))], axis=1)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that later steps depend on, themselves."""
        bodies = self.bodies
        parts = ("state", "sent", "held", "waited", "tilting", "gyro", "pressure", "fallen", "touching")
        own = {name: getattr(bodies, name) for name in parts}
        return {**own, **vars(self.gait), **vars(self.traits), "noise": self._noise}
