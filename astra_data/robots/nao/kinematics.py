"""The NAO's legs: their angles in closed form, and how robots differ; links and joints are in nao.xml.

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

TICK_S = 0.012
"""The robot's own motion cycle (83 Hz), as B-Human's code states it."""
GRAVITY = 9.81
HIP_OFFSET_Y_M = 0.050
HIP_OFFSET_Z_M = 0.085
THIGH_M = 0.100
TIBIA_M = 0.1029
FOOT_HEIGHT_M = 0.04519
_LEG = ("HipRoll", "HipPitch", "KneePitch", "AnklePitch", "AnkleRoll")
JOINTS = ("HipYawPitch", *(f"{side}{name}" for side in "LR" for name in _LEG))
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
