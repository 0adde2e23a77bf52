"""The NAO's body as a MuJoCo model: twelve leg joints, rigid arms and head, primitive shapes.

Only collisions that matter to walking are simulated: four points of each sole with the floor, both feet and
the chest with the walls, feet and shanks with the ball. A fallen robot sinks into the floor.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import mujoco

from astra_data.robots.nao.links import (
    ARM,
    FOOT_HEIGHT_M,
    FOOT_M,
    FOOT_TOP_M,
    HEAD,
    LEG,
    SHOULDER_M,
    SOLE_POINTS_M,
    TIBIA_M,
    TORSO,
    Link,
)
from astra_data.worlds.batched_mujoco import attribute
from astra_data.worlds.plane.ball import BALL_RADIUS_M, ROLLING_M_S2
from astra_data.worlds.plane.mazes import Maze

TICK_S = 0.012
"""The robot's own motion cycle (83 Hz), as B-Human's code states it."""
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
GRAVITY = 9.81
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
