"""The NAO's links and joints in numbers, its legs' angles in closed form, and how robots differ.

Sources: Aldebaran's documentation of the NAO H25 (links, joints, masses); B-Human's published calibration of
the V6 (masses, limits, soles; centers of mass from its calibration of the V4, whose links are the same).
Frames are Aldebaran's: in the zero posture all are parallel, x forward, y to the left, z up. Only left limbs
are listed; right ones are their mirror images.

A foot's pose is that of its sole below the ankle, in the torso's frame: x, y, z in m, roll, pitch, yaw in rad
(rotation Rz(yaw) Ry(pitch) Rx(roll)). Both legs share one motor that turns the hips about axes tilted by 45°
(yaw and pitch at once), so there are eleven angles for twelve joints, and the feet's yaws depend on each
other: the motor takes the mean of the angles that each foot alone would need; the other joints then keep the
soles' positions and planes exact.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats

Triple = tuple[float, float, float]

TICK_S = 0.012
"""The robot's own motion cycle (83 Hz), as B-Human's code states it."""
GRAVITY = 9.81
HIP_OFFSET_Y_M = 0.050
HIP_OFFSET_Z_M = 0.085
THIGH_M = 0.100
TIBIA_M = 0.1029
FOOT_HEIGHT_M = 0.04519
SHOULDER_M: Triple = (0.0, 0.098, 0.100)
NECK_M: Triple = (0.0, 0.0, 0.1265)

SOLE_POINTS_M = ((0.100, 0.048), (0.100, -0.038), (-0.048, 0.048), (-0.048, -0.038))
"""Contact points of the left sole, from the ankle: the corners of its outline; in front, where the toes are
round, as far ahead as the pressure sensors. In the order of the sensors: front left, front right, back left,
back right."""
FOOT_M = ((-0.048, 0.114), (-0.038, 0.048))
"""Outline of the left foot, from the ankle: back and front, inner and outer."""
FOOT_TOP_M = 0.040
"""Height of the foot's shell over the sole, ours: about that of its bumper."""


@dataclass(frozen=True)
class Link:
    """A rigid link with its joint to the parent, if it has one.

    Attributes:
        name: its joint's name in Aldebaran's documentation, without the side. offset_m: its frame's origin in
        the parent's frame. mass_kg: its mass. center_m: its center of mass. inertia: about the center of mass
        along the frame's axes, in kg m². axis: the joint's axis; None for a fixed link. limits_deg: the
        joint's range.
    """

    name: str
    offset_m: Triple
    mass_kg: float
    center_m: Triple
    inertia: Triple
    axis: Triple | None = None
    limits_deg: tuple[float, float] = (0.0, 0.0)


def box_inertia(mass_kg: float, size_m: Triple) -> Triple:
    """Return the moments of inertia in kg m² of a solid box, for links whose own are not listed here."""
    x, y, z = size_m
    share = mass_kg / 12
    return share * (y * y + z * z), share * (x * x + z * z), share * (x * x + y * y)


# Torso and thigh: the published tensors about the joint, moved to the center of mass. All others: boxes of
# about the links' outer size, ours.
TORSO = Link("Torso", (0, 0, 0), 1.0496, (-0.00413, 0, 0.04342), (3.08e-3, 2.88e-3, 1.59e-3))
HEAD = (
    Link("HeadYaw", NECK_M, 0.0784, (0, 0, -0.02742), box_inertia(0.0784, (0.04, 0.04, 0.08))),
    Link("HeadPitch", NECK_M, 0.6594, (-0.00112, 0, 0.05258), box_inertia(0.6594, (0.11, 0.13, 0.12))),
)
# Offsets from the shoulder, the arm stretched forward; the center of mass of forearm and hand is ours.
ARM = (
    Link("ShoulderPitch", (0, 0, 0), 0.0930, (-0.00165, -0.02663, 0.00014), (8.4e-5, 8.4e-5, 8.4e-5)),
    Link(
        "ShoulderRoll", (0, 0, 0), 0.1578, (0.02455, 0.00563, 0.0033), box_inertia(0.1578, (0.11, 0.05, 0.06))
    ),
    Link(
        "ElbowYaw",
        (0.105, 0.015, 0),
        0.0648,
        (-0.02744, 0, -0.00014),
        box_inertia(0.0648, (0.06, 0.04, 0.04)),
    ),
    Link("ElbowRoll", (0.105, 0.015, 0), 0.0776, (0.028, 0, 0), box_inertia(0.0776, (0.056, 0.05, 0.05))),
    Link("WristYaw", (0.16095, 0.015, 0), 0.1853, (0.034, 0, 0.003), box_inertia(0.1853, (0.1, 0.06, 0.05))),
)
_DIAGONAL = 0.5**0.5
LEG = (
    Link(
        "HipYawPitch",
        (0, HIP_OFFSET_Y_M, -HIP_OFFSET_Z_M),
        0.0698,
        (-0.00781, -0.01114, 0.02661),
        box_inertia(0.0698, (0.05, 0.05, 0.06)),
        (0, _DIAGONAL, -_DIAGONAL),
        (-65.62, 42.44),
    ),
    Link(
        "HipRoll",
        (0, 0, 0),
        0.1405,
        (-0.01549, 0.00029, -0.00515),
        box_inertia(0.1405, (0.07, 0.05, 0.05)),
        (1, 0, 0),
        (-21.74, 45.29),
    ),
    Link(
        "HipPitch",
        (0, 0, 0),
        0.3897,
        (0.00138, 0.00221, -0.05373),
        (5.1e-4, 4.7e-4, 3.0e-4),
        (0, 1, 0),
        (-88.0, 27.73),
    ),
    Link(
        "KneePitch",
        (0, 0, -THIGH_M),
        0.3014,
        (0.00453, 0.00225, -0.04936),
        box_inertia(0.3014, (0.08, 0.07, 0.13)),
        (0, 1, 0),
        (-5.29, 121.04),
    ),
    Link(
        "AnklePitch",
        (0, 0, -TIBIA_M),
        0.1342,
        (0.00045, 0.00029, 0.00685),
        box_inertia(0.1342, (0.06, 0.05, 0.05)),
        (0, 1, 0),
        (-68.15, 52.86),
    ),
    Link(
        "AnkleRoll",
        (0, 0, 0),
        0.1718,
        (0.02542, 0.0033, -0.03239),
        box_inertia(0.1718, (0.16, 0.08, 0.04)),
        (1, 0, 0),
        (-22.79, 44.06),
    ),
)
LEG_JOINTS = tuple(link.name for link in LEG)


JOINTS = ("HipYawPitch", *(f"L{name}" for name in LEG_JOINTS[1:]), *(f"R{name}" for name in LEG_JOINTS[1:]))
"""The eleven angles, in order."""
TO_MOTORS = np.array([0, 1, 2, 3, 4, 5, 0, 6, 7, 8, 9, 10])
"""Which of the eleven angles each of the model's twelve controls follows."""

_HIP = np.array([0.0, HIP_OFFSET_Y_M, -HIP_OFFSET_Z_M])
_TILT = np.pi / 4
# Mirrors a pose (x, y, z, roll, pitch, yaw), and a leg's own five angles.
_MIRRORED_POSE = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
_MIRRORED_LEG = np.array([-1.0, 1.0, 1.0, 1.0, -1.0])


def about_x(angle: Floats) -> Floats:
    """Return rotations about x, (..., 3, 3)."""
    return _rotation(angle, 1, 2)


def about_y(angle: Floats) -> Floats:
    """Return rotations about y, (..., 3, 3)."""
    return _rotation(angle, 2, 0)


def about_z(angle: Floats) -> Floats:
    """Return rotations about z, (..., 3, 3)."""
    return _rotation(angle, 0, 1)


def _rotation(angle: Floats, first: int, second: int) -> Floats:
    matrix = np.zeros((*np.shape(angle), 3, 3))
    matrix[..., range(3), range(3)] = 1.0
    cos, sin = np.cos(angle), np.sin(angle)
    matrix[..., first, first] = matrix[..., second, second] = cos
    matrix[..., second, first], matrix[..., first, second] = sin, -sin
    return matrix


def leg_angles(poses: Floats) -> Floats:
    """Return the eleven joint angles (..., 11) in rad that bring the feet to `poses` (..., 2, 6), left first.

    Positions beyond a leg's reach are approached with a straight leg. Joint limits are not applied.
    """
    mirrored = poses.copy()
    mirrored[..., 1, :] *= _MIRRORED_POSE
    roll, pitch, yaw = np.moveaxis(mirrored[..., 3:], -1, 0)
    foot = about_z(yaw) @ about_y(pitch) @ about_x(roll)
    ankle = mirrored[..., :3] + FOOT_HEIGHT_M * foot[..., 2] - _HIP
    distance = np.linalg.norm(ankle, axis=-1)
    knee, thigh_lead = _triangle(distance)
    wanted = _wanted_hip_yaw_pitch(foot, ankle, knee, thigh_lead)
    shared = np.broadcast_to(wanted.mean(axis=-1, keepdims=True), wanted.shape)

    hips = _hip_yaw_pitch(shared)
    x, y, z = np.moveaxis((np.swapaxes(hips, -1, -2) @ ankle[..., None])[..., 0], -1, 0)
    hip_roll = np.arctan2(y, -z)
    hip_pitch = np.arctan2(-x, np.hypot(y, z)) - thigh_lead
    tibia = hips @ about_x(hip_roll) @ about_y(hip_pitch + knee)
    up_x, up_y, up_z = np.moveaxis((np.swapaxes(tibia, -1, -2) @ foot[..., 2][..., None])[..., 0], -1, 0)
    ankle_roll = -np.arcsin(np.clip(up_y, -1.0, 1.0))
    ankle_pitch = np.arctan2(up_x, up_z)

    legs = np.stack([hip_roll, hip_pitch, knee, ankle_pitch, ankle_roll], axis=-1)
    return np.concatenate([shared[..., 0, None], legs[..., 0, :], legs[..., 1, :] * _MIRRORED_LEG], axis=-1)


def _hip_yaw_pitch(angle: Floats) -> Floats:
    """Return rotations about the left leg's tilted axis (0, 1, -1) / √2."""
    tilt = np.asarray(_TILT)
    return np.asarray(about_x(-tilt) @ about_y(angle) @ about_x(tilt))


def _triangle(distance: Floats) -> tuple[Floats, Floats]:
    """Return the knee's angle, and the angle from hip-ankle line to thigh, at a hip-ankle distance."""
    length = np.clip(distance, 1e-6, THIGH_M + TIBIA_M)
    bend = (THIGH_M**2 + TIBIA_M**2 - length**2) / (2 * THIGH_M * TIBIA_M)
    knee = np.pi - np.arccos(np.clip(bend, -1.0, 1.0))
    thigh_lead = np.arctan2(TIBIA_M * np.sin(knee), THIGH_M + TIBIA_M * np.cos(knee))
    return knee, thigh_lead


def _wanted_hip_yaw_pitch(foot: Floats, ankle: Floats, knee: Floats, thigh_lead: Floats) -> Floats:
    """Return the tilted joint's angle at which a (left) leg alone has no error of yaw.

    In the foot's frame, the position of the hip determines the ankle's two angles. The rest of the foot's
    rotation is the hip's, Ry(shared) Rx(roll + 45°) Ry(pitch) in a frame turned by 45°, whose angles can be
    read off.
    """
    x, y, z = np.moveaxis((np.swapaxes(foot, -1, -2) @ -ankle[..., None])[..., 0], -1, 0)
    ankle_roll = np.arctan2(y, z)
    # In the foot's plane of pitch the hip lies behind the tibia by the rest of the triangle.
    ankle_pitch = -(np.arctan2(x, np.hypot(y, z)) + knee - thigh_lead)
    tibia = foot @ about_x(-ankle_roll) @ about_y(-ankle_pitch)
    hip = about_x(np.asarray(_TILT)) @ tibia @ about_y(-knee)
    return np.asarray(np.arctan2(hip[..., 0, 1], hip[..., 2, 1]))


@dataclass(frozen=True)
class TraitSpread:
    """Ranges that a robot's traits are drawn from; ours where no source is named."""

    joint_offset_deg: float = 0.35
    """Standard deviation of each joint's zero, which makes a robot veer; with 0.7 some turn the wrong way."""
    stiffness_loss: float = 0.3
    """Largest share of the servos' stiffness that is missing."""
    delay_ticks: tuple[int, int] = (2, 3)
    """Range of the delay from command to servo."""
    friction: tuple[float, float] = (0.4, 0.8)
    """Range of the floor's friction."""
    gyro_noise_rad_s: float = 0.05
    """Standard deviation per tick and axis: the same for all robots."""
    quality: tuple[float, float] = (0.83, 1.0)
    """Range of the factor on the top speeds: B-Human's limits of a worn and of a new robot."""


IDENTICAL = TraitSpread(0.0, 0.0, (2, 2), (0.6, 0.6), 0.0, (1.0, 1.0))
"""All robots alike, without noise."""


@dataclass(frozen=True)
class Traits:
    """The traits of B robots.

    Attributes:
        joint_offset_rad: true minus measured joint angles, (B, 11). stiffness: share of the servos'
        stiffness, (B,). delay_ticks: from command to servo, (B,) int. friction: of the floor, (B,). quality:
        factor on the top speeds, (B,).
    """

    joint_offset_rad: Floats
    stiffness: Floats
    delay_ticks: NDArray[np.intp]
    friction: Floats
    quality: Floats

    @classmethod
    def draw(cls, spread: TraitSpread, count: int, rng: np.random.Generator) -> "Traits":
        """Draw the traits of `count` robots."""
        return cls(
            joint_offset_rad=np.radians(rng.normal(0.0, spread.joint_offset_deg, (count, len(JOINTS)))),
            stiffness=1.0 - rng.uniform(0.0, spread.stiffness_loss, count),
            delay_ticks=rng.integers(*spread.delay_ticks, count, endpoint=True, dtype=np.intp),
            friction=rng.uniform(*spread.friction, count),
            quality=rng.uniform(*spread.quality, count),
        )
