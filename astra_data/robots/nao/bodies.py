"""The NAO's body as a MuJoCo model, and B of them: physics, servos, ankle reflex, 16 ticks per control step.

Twelve leg joints, rigid arms and head, primitive shapes. Only collisions that matter to walking are
simulated: four points of each sole with the floor, both feet and the chest with the walls, feet and shanks
with the ball. A fallen robot sinks into the floor.

A robot's whole control step runs in one thread, so that results do not depend on the number of threads. The
robot's own friction and stiffness are first written into the thread's copy of the model.
"""

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from math import atan2

import mujoco
import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.robots.nao.kicking import BALL_RADIUS_M, ROLLING_M_S2
from astra_data.robots.nao.kinematics import (
    ARM,
    FOOT_HEIGHT_M,
    FOOT_M,
    FOOT_TOP_M,
    GRAVITY,
    HEAD,
    LEG,
    SHOULDER_M,
    SOLE_POINTS_M,
    TIBIA_M,
    TICK_S,
    TO_MOTORS,
    TORSO,
    Link,
    Traits,
)
from astra_data.robots.nao.walk import Targets, WalkStyle
from astra_data.worlds.batched_mujoco import attribute, share_out, views, wall_geoms
from astra_data.worlds.plane.mazes import Maze

SUBSTEPS = 3
"""Physics steps per tick: 4 ms each."""
STIFFNESS_NM_PER_RAD = 100.0
"""Of a servo at full stiffness, at a damping ratio of 0.68; ours, like damping and armature."""
DAMPING_NM_S_PER_RAD = 1.5
ARMATURE_KG_M2 = 0.012
ROLL_TORQUE_NM = 8.0
"""Between nominal (2.5) and stall (12.0) torque of Aldebaran's motor table; yaw and roll joints."""
PITCH_TORQUE_NM = 5.5
"""Between nominal (1.6) and stall torque (7.8) likewise."""
WALL_HEIGHT_M = 0.5
BALL_MASS_KG = 0.045
"""Of SimRobot's model of the league's ball."""
# A rolling solid sphere is slowed by c g / (1.4 R), c being the coefficient of rolling friction.
_ROLLING_M = ROLLING_M_S2 * 1.4 * BALL_RADIUS_M / GRAVITY
_SOLE_POINT_RADIUS_M = 0.005
# Collision bits.
_FLOOR, _WALL, _LEG = 1, 2, 4

SIDES = (("L", 1.0), ("R", -1.0))


def nao_model(maze: Maze | None = None, *, ball: bool = False) -> mujoco.MjModel:
    """Build a NAO on a floor.

    qpos: torso x, y, z, quaternion (7), left leg's six joints, right leg's six, the ball's pose (7).
    Controls: twelve joint angles in rad in the same order; both hip yaw-pitch joints are coupled.

    Args:
        maze: walls to add, one box per wall cell; none for an open floor.
        ball: add a ball.
    """
    root = ElementTree.Element("mujoco", model="nao")
    ElementTree.SubElement(root, "compiler", angle="degree", fusestatic="true", autolimits="true")
    ElementTree.SubElement(
        root,
        "option",
        timestep=str(TICK_S / SUBSTEPS),
        gravity=f"0 0 {-GRAVITY}",
        integrator="implicitfast",
        cone="elliptic",  # pyramids let the ball roll too far
        iterations="20",
        ls_iterations="10",
    )
    world = ElementTree.SubElement(root, "worldbody")
    _geom(world, "floor", "plane", (0, 0, 1), collides=(_FLOOR, 0))
    if maze:
        size = (0.5 * maze.scale, 0.5 * maze.scale, WALL_HEIGHT_M / 2)
        for row, column in maze.wall_cells():
            place = (*maze.cell_center(row, column), WALL_HEIGHT_M / 2)
            _geom(world, f"block_{row}_{column}", "box", size, at=place, collides=(_WALL, 0))
    torso = _body(world, TORSO, "Torso", 1.0)
    ElementTree.SubElement(torso, "freejoint", name="root")
    _geom(torso, "chest", "capsule", (0.06, 0.075), at=(0, 0, 0.06), euler=(90, 0, 0), collides=(0, _WALL))
    for link in HEAD:
        _body(torso, link, link.name, 1.0)
    actuators, sensors = ElementTree.SubElement(root, "actuator"), ElementTree.SubElement(root, "sensor")
    for side, sign in SIDES:
        x, y, z = SHOULDER_M
        shoulder = ElementTree.SubElement(torso, "body", pos=attribute((x, sign * y, z)), euler="0 90 0")
        for link in ARM:
            _body(shoulder, link, side + link.name, sign)
        foot = _leg(torso, side, sign, actuators, ball=ball)
        for number in range(4):
            # Mirrored, left points become right ones.
            along, across = SOLE_POINTS_M[number if sign > 0 else number ^ 1]
            name, radius = f"{side}Sole{number}", (_SOLE_POINT_RADIUS_M,)
            place = (along, sign * across, _SOLE_POINT_RADIUS_M - FOOT_HEIGHT_M)
            _geom(foot, name, "sphere", radius, at=place, friction=(0, 0, 0), collides=(0, _FLOOR))
            ElementTree.SubElement(foot, "site", name=name, pos=attribute(place), size="0.008")
            ElementTree.SubElement(sensors, "touch", name=name, site=name)
    equality = ElementTree.SubElement(root, "equality")
    ElementTree.SubElement(equality, "joint", joint1="LHipYawPitch", joint2="RHipYawPitch")
    if ball:
        body = ElementTree.SubElement(world, "body", name="ball", pos=f"1 0 {BALL_RADIUS_M}")
        ElementTree.SubElement(body, "freejoint", name="ball")
        friction_of_ball, collides = (0.4, 0.0, _ROLLING_M), (0, _FLOOR | _WALL | _LEG)
        geom = _geom(body, "ball", "sphere", (BALL_RADIUS_M,), friction=friction_of_ball, collides=collides)
        geom.set("mass", str(BALL_MASS_KG))
        geom.set("condim", "6")
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))


def _leg(
    torso: ElementTree.Element, side: str, sign: float, actuators: ElementTree.Element, *, ball: bool
) -> ElementTree.Element:
    parent = torso
    for link in LEG:
        name = side + link.name
        parent = _body(parent, link, name, sign)
        torque = PITCH_TORQUE_NM if link.axis == (0, 1, 0) else ROLL_TORQUE_NM
        ElementTree.SubElement(
            actuators,
            "position",
            name=name,
            joint=name,
            kp=str(STIFFNESS_NM_PER_RAD),
            kv=str(DAMPING_NM_S_PER_RAD),
            forcerange=f"{-torque} {torque}",
        )
        if ball and link.name == "KneePitch":
            shank, middle = (0.03, TIBIA_M / 2 - 0.03), (0, 0, -TIBIA_M / 2)
            _geom(parent, f"{side}Shank", "capsule", shank, at=middle, collides=(_LEG, 0))
    (back, front), (inner, outer) = FOOT_M
    size = ((front - back) / 2, (outer - inner) / 2, (FOOT_TOP_M - 0.002) / 2)
    place = ((front + back) / 2, sign * (outer + inner) / 2, -FOOT_HEIGHT_M + 0.002 + size[2])
    _geom(parent, f"{side}Foot", "box", size, at=place, collides=(_LEG, _WALL))
    return parent


def _body(parent: ElementTree.Element, link: Link, name: str, sign: float) -> ElementTree.Element:
    """Add a link's body with its joint, mirrored for `sign` -1."""
    x, y, z = link.offset_m
    body = ElementTree.SubElement(parent, "body", name=name, pos=attribute((x, sign * y, z)))
    x, y, z = link.center_m
    center, inertia = attribute((x, sign * y, z)), attribute(link.inertia)
    ElementTree.SubElement(body, "inertial", pos=center, mass=str(link.mass_kg), diaginertia=inertia)
    if link.axis is not None:
        low, high = joint_limits_deg(link, sign)
        x, y, z = link.axis
        ElementTree.SubElement(
            body,
            "joint",
            name=name,
            axis=attribute((x, y, sign * z)),
            range=f"{low} {high}",
            armature=str(ARMATURE_KG_M2),
        )
    return body


def joint_limits_deg(link: Link, sign: float) -> tuple[float, float]:
    """Return the range of a leg's joint on the left (`sign` 1) or right (-1): roll angles are mirrored."""
    low, high = link.limits_deg
    return (-high, -low) if sign < 0 and link.axis == (1, 0, 0) else (low, high)


def _geom(
    body: ElementTree.Element,
    name: str,
    shape: str,
    size: Sequence[float],
    *,
    at: Sequence[float] = (0, 0, 0),
    euler: Sequence[float] = (0, 0, 0),
    friction: Sequence[float] = (0.6, 0.005, 0.0),
    collides: tuple[int, int],
) -> ElementTree.Element:
    return ElementTree.SubElement(
        body,
        "geom",
        name=name,
        type=shape,
        size=attribute(size),
        pos=attribute(at),
        euler=attribute(euler),
        friction=attribute(friction),
        contype=str(collides[0]),
        conaffinity=str(collides[1]),
        mass="0",
    )


TICKS = 16
"""Per control step."""
FALLEN_COSINE = 0.7
"""A robot has fallen when the cosine between its up axis and the vertical is below this (45°)."""
MOTORS = len(TO_MOTORS)

_STATE = int(
    mujoco.mjtState.mjSTATE_FULLPHYSICS | mujoco.mjtState.mjSTATE_WARMSTART | mujoco.mjtState.mjSTATE_CTRL
)
# Ankles among the motors: pitch, roll; left, right.
_ANKLES = ((4, 5), (10, 11))


class BatchedBodies:
    """B bodies of one model.

    Attributes:
        state: MuJoCo's full states, (B, N). qpos, qvel: views of it, (B, nq), (B, nv). sent: angles sent to
        the servos, (B, delay + 16, 12) in rad: the last ticks of the previous control step, which may not
        have arrived, then this one's. tilting: low-passed measured rates about x and y, (B, 2) in rad/s.
        held: angles planned for the last tick, (B, 12) in rad. waited: ticks for which the present lift of a
        foot has been delayed, (B,) int. gyro: last measured rates, (B, 3) in rad/s. pressure: on the points
        of the soles, left foot's then right foot's, (B, 8) in N. fallen: (B,) bool; a fallen robot stays as
        it is until its reset. touching: whether the robot touched a wall in its last control step, (B,) bool.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        traits: Traits,
        *,
        longest_delay_ticks: int,
        style: WalkStyle,
        num_threads: int,
    ) -> None:
        """Allocate one body for each of `traits`' B robots; `reset` them before they are stepped."""
        self.model = model
        self.traits = traits
        self.style = style
        count = len(traits.stiffness)
        self.state: Floats = np.zeros((count, mujoco.mj_stateSize(model, _STATE)))
        self.qpos, self.qvel = views(model, self.state)
        self.sent: Floats = np.zeros((count, longest_delay_ticks + TICKS, MOTORS))
        self.tilting: Floats = np.zeros((count, 2))
        self.held: Floats = np.zeros((count, MOTORS))
        self.waited: NDArray[np.intp] = np.zeros(count, dtype=np.intp)
        self.gyro: Floats = np.zeros((count, 3))
        self.pressure: Floats = np.zeros((count, 8))
        self.fallen: Bools = np.zeros(count, dtype=bool)
        self.touching: Bools = np.zeros(count, dtype=bool)
        self._walls = wall_geoms(model)
        self._robot_geoms = np.zeros(model.ngeom, dtype=bool)
        self._robot_geoms[[model.geom(name).id for name in ("chest", "LFoot", "RFoot")]] = True
        self._models = [copy.copy(model) for _ in range(min(num_threads, count))]
        self._data = [mujoco.MjData(one) for one in self._models]
        self._pool = ThreadPoolExecutor(len(self._models))

    def reset(self, rows: NDArray[np.intp], qpos: Floats, angles: Floats) -> None:
        """Set the bodies `rows` (n,) at rest at `qpos` (n, nq), their servos holding `angles` (n, 12)."""
        data = self._data[0]
        for row, position in zip(rows, qpos, strict=True):
            mujoco.mj_resetData(self.model, data)
            data.qpos[:] = position
            mujoco.mj_forward(self.model, data)
            mujoco.mj_getState(self.model, data, self.state[row], _STATE)
        self.sent[rows], self.held[rows] = angles[:, None], angles
        for part in (self.waited, self.tilting, self.gyro, self.pressure, self.fallen, self.touching):
            part[rows] = 0

    def step(self, rows: NDArray[np.intp], targets: Targets, noise: Floats) -> NDArray[np.intp]:
        """Run the bodies `rows` (n,) through one control step.

        Args:
            rows: which bodies; fallen ones are left as they are.
            targets: of the legs of all B.
            noise: of the gyroscope, (B, 16, 3) in rad/s.

        Returns:
            The number of ticks of the targets that were followed, (B,) int; in the others a lift was delayed.
        """
        self.touching[rows] = False
        rows = rows[~self.fallen[rows]]
        before = self.sent.shape[1] - TICKS
        self.sent[rows, :before] = self.sent[rows, TICKS:]
        followed = np.zeros(len(self.fallen), dtype=np.intp)
        work = partial(self._step_rows, targets, noise, followed)
        share_out(rows.tolist(), self._pool, work, len(self._models))
        return followed

    def _step_rows(
        self, targets: Targets, noise: Floats, followed: NDArray[np.intp], thread: int, rows: Iterator[int]
    ) -> None:
        model, data, traits = self._models[thread], self._data[thread], self.traits
        floor = model.geom("floor").id
        for row in rows:
            model.geom_friction[floor, 0] = traits.friction[row]
            stiffness = STIFFNESS_NM_PER_RAD * traits.stiffness[row]
            model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1] = stiffness, -stiffness
            mujoco.mj_setState(model, data, self.state[row], _STATE)
            followed[row] = self._walk(model, data, row, targets, noise[row])
            mujoco.mj_getState(model, data, self.state[row], _STATE)
            self.pressure[row] = data.sensordata

    def _walk(
        self, model: mujoco.MjModel, data: mujoco.MjData, row: int, targets: Targets, noise: Floats
    ) -> int:
        style, sent, rates, step = self.style, self.sent[row], data.qvel[3:6], mujoco.mj_step
        planned = (targets.angles[row] + self.traits.joint_offset_rad[row])[:, TO_MOTORS]
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

    def _touches(self, data: mujoco.MjData) -> bool:
        """Return whether the robot, not the ball, touches a wall."""
        first, last = self._walls or (0, -1)
        geoms = data.contact.geom
        walls = (geoms >= first) & (geoms <= last)
        return bool((walls[:, ::-1] & self._robot_geoms[geoms]).any())
