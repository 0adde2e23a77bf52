"""The NAO's legs: joint angles to foot poses and, in closed form, back.

A foot's pose is that of its sole below the ankle, in the torso's frame: x, y, z in m, roll, pitch, yaw in rad
(rotation Rz(yaw) Ry(pitch) Rx(roll)). Both legs share one motor that turns the hips about axes tilted by 45°
(yaw and pitch at once), so there are eleven angles for twelve joints, and the feet's yaws depend on each
other: the motor takes the mean of the angles that each foot alone would need; the other joints then keep the
soles' positions and planes exact.

The right leg is solved as the left leg's mirror image.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats
from astra_data.robots.nao.links import (
    FOOT_HEIGHT_M,
    HIP_OFFSET_Y_M,
    HIP_OFFSET_Z_M,
    LEG_JOINTS,
    THIGH_M,
    TIBIA_M,
)
from astra_data.worlds.plane.geometry import wrapped

JOINTS = ("HipYawPitch", *(f"L{name}" for name in LEG_JOINTS[1:]), *(f"R{name}" for name in LEG_JOINTS[1:]))
"""The eleven angles, in order."""
TO_MOTORS = np.array([0, 1, 2, 3, 4, 5, 0, 6, 7, 8, 9, 10])
"""Which of the eleven angles each of the model's twelve controls follows."""

_HIP = np.array([0.0, HIP_OFFSET_Y_M, -HIP_OFFSET_Z_M])
_TILT = np.pi / 4
# Mirrors a pose (x, y, z, roll, pitch, yaw), and a leg's own five angles.
_MIRRORED_POSE = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
_MIRRORED_LEG = np.array([-1.0, 1.0, 1.0, 1.0, -1.0])


@dataclass(frozen=True)
class LegAngles:
    """Joint angles for a pair of foot poses.

    Attributes:
        angles: the eleven angles in rad, (..., 11).
        yaw_error: yaw reached minus yaw wanted, left and right, in rad, (..., 2).
        reached: whether the foot is within the leg's length from the hip, (..., 2) bool.
    """

    angles: Floats
    yaw_error: Floats
    reached: NDArray[np.bool_]


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


def foot_poses(angles: Floats) -> Floats:
    """Return left and right foot pose (..., 2, 6) at the eleven `angles` (..., 11) in rad."""
    shared = np.broadcast_to(angles[..., None, :1], (*angles.shape[:-1], 2, 1))
    legs = np.stack([angles[..., 1:6], angles[..., 6:] * _MIRRORED_LEG], axis=-2)
    roll, pitch, knee, ankle_pitch, ankle_roll = np.moveaxis(legs, -1, 0)
    thigh = _hip_yaw_pitch(shared[..., 0]) @ about_x(roll) @ about_y(pitch)
    tibia = thigh @ about_y(knee)
    foot = tibia @ about_y(ankle_pitch) @ about_x(ankle_roll)
    position = _HIP - THIGH_M * thigh[..., 2] - TIBIA_M * tibia[..., 2] - FOOT_HEIGHT_M * foot[..., 2]
    poses = np.concatenate([position, _roll_pitch_yaw(foot)], axis=-1)
    poses[..., 1, :] *= _MIRRORED_POSE
    return np.asarray(poses)


def leg_angles(poses: Floats) -> LegAngles:
    """Solve for the joint angles that bring the feet to `poses` (..., 2, 6), left then right.

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
    reached_foot = tibia @ about_y(ankle_pitch) @ about_x(ankle_roll)
    error = wrapped(_roll_pitch_yaw(reached_foot)[..., 2] - yaw)
    error[..., 1] *= -1.0
    return LegAngles(
        angles=np.concatenate(
            [shared[..., 0, None], legs[..., 0, :], legs[..., 1, :] * _MIRRORED_LEG], axis=-1
        ),
        yaw_error=error,
        reached=distance <= THIGH_M + TIBIA_M,
    )


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


def _roll_pitch_yaw(rotation: Floats) -> Floats:
    return np.stack(
        [
            np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2]),
            np.arcsin(np.clip(-rotation[..., 2, 0], -1.0, 1.0)),
            np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]),
        ],
        axis=-1,
    )
