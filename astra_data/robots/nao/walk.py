"""The NAO's legs: their angles in closed form, how robots differ, how they walk; links and joints are in nao.xml.

Poses of feet are those of soles in the torso's frame: x, y, z in m, roll, pitch, yaw in rad. One motor turns both hips:
it takes the mean of what each foot needs; the other joints keep the soles' positions and planes exact.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats

TICK_S = 0.012  # the robot's own motion cycle (83 Hz), as B-Human's code states it
GRAVITY = 9.81
HIP_OFFSET_Y_M, HIP_OFFSET_Z_M = 0.050, 0.085
THIGH_M, TIBIA_M, FOOT_HEIGHT_M = 0.100, 0.1029, 0.04519
_LEG = ("HipRoll", "HipPitch", "KneePitch", "AnklePitch", "AnkleRoll")
JOINTS = ("HipYawPitch", *(f"{side}{name}" for side in "LR" for name in _LEG))  # the eleven angles, in order
TO_MOTORS = np.array([0, 1, 2, 3, 4, 5, 0, 6, 7, 8, 9, 10])  # which of the eleven angles each control follows

_HIP = np.array([0.0, HIP_OFFSET_Y_M, -HIP_OFFSET_Z_M])
_TILT = np.pi / 4
# Mirrors a pose (x, y, z, roll, pitch, yaw), and a leg's own five angles.
_MIRRORED_POSE = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
_MIRRORED_LEG = np.array([-1.0, 1.0, 1.0, 1.0, -1.0])


def _about(axis: int, angle: Floats) -> Floats:
    """Return rotations about x, y or z, the `axis` of that number, (..., 3, 3)."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((*np.shape(angle), 3, 3))
    matrix[..., range(3), range(3)] = 1.0
    cos, sin = np.cos(angle), np.sin(angle)
    matrix[..., first, first] = matrix[..., second, second] = cos
    matrix[..., second, first], matrix[..., first, second] = sin, -sin
    return matrix


about_x, about_y, about_z = (partial(_about, axis) for axis in range(3))


def leg_angles(poses: Floats) -> Floats:
    """Return angles (..., 11) in rad, limits not applied, that bring the feet to `poses` (..., 2, 6), left first."""
    mirrored = poses.copy()
    mirrored[..., 1, :] *= _MIRRORED_POSE
    roll, pitch, yaw = np.moveaxis(mirrored[..., 3:], -1, 0)
    foot = about_z(yaw) @ about_y(pitch) @ about_x(roll)
    ankle = mirrored[..., :3] + FOOT_HEIGHT_M * foot[..., 2] - _HIP
    distance = np.linalg.norm(ankle, axis=-1)
    knee, thigh_lead = _triangle(distance)
    wanted = _wanted_hip_yaw_pitch(foot, ankle, knee, thigh_lead)
    shared = np.broadcast_to(wanted.mean(axis=-1, keepdims=True), wanted.shape)

    tilt = np.asarray(_TILT)
    hips = about_x(-tilt) @ about_y(shared) @ about_x(tilt)  # about the left leg's tilted axis (0, 1, -1) / √2
    x, y, z = np.moveaxis((np.swapaxes(hips, -1, -2) @ ankle[..., None])[..., 0], -1, 0)
    hip_roll = np.arctan2(y, -z)
    hip_pitch = np.arctan2(-x, np.hypot(y, z)) - thigh_lead
    tibia = hips @ about_x(hip_roll) @ about_y(hip_pitch + knee)
    up_x, up_y, up_z = np.moveaxis((np.swapaxes(tibia, -1, -2) @ foot[..., 2][..., None])[..., 0], -1, 0)
    ankle_roll = -np.arcsin(np.clip(up_y, -1.0, 1.0))
    ankle_pitch = np.arctan2(up_x, up_z)

    legs = np.stack([hip_roll, hip_pitch, knee, ankle_pitch, ankle_roll], axis=-1)
    return np.concatenate([shared[..., 0, None], legs[..., 0, :], legs[..., 1, :] * _MIRRORED_LEG], axis=-1)


def _triangle(distance: Floats) -> tuple[Floats, Floats]:
    """Return the knee's angle, and the angle from hip-ankle line to thigh, at a hip-ankle distance."""
    length = np.clip(distance, 1e-6, THIGH_M + TIBIA_M)
    bend = (THIGH_M**2 + TIBIA_M**2 - length**2) / (2 * THIGH_M * TIBIA_M)
    knee = np.pi - np.arccos(np.clip(bend, -1.0, 1.0))
    thigh_lead = np.arctan2(TIBIA_M * np.sin(knee), THIGH_M + TIBIA_M * np.cos(knee))
    return knee, thigh_lead


def _wanted_hip_yaw_pitch(foot: Floats, ankle: Floats, knee: Floats, thigh_lead: Floats) -> Floats:
    """Return the tilted joint's angle at which a (left) leg alone has no error of yaw."""
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
    stiffness_loss: float = 0.3  # largest share of the servos' stiffness that is missing
    delay_ticks: tuple[int, int] = (2, 3)  # range of the delay from command to servo
    friction: tuple[float, float] = (0.4, 0.8)  # range of the floor's friction
    gyro_noise_rad_s: float = 0.05  # standard deviation per tick and axis: the same for all robots
    quality: tuple[float, float] = (0.83, 1.0)
    """Range of the factor on the top speeds: B-Human's limits of a worn and of a new robot."""


@dataclass(frozen=True)
class Traits:
    """The traits of B robots."""

    joint_offset_rad: Floats  # true minus measured joint angles, (B, 11)
    stiffness: Floats  # share of the servos' stiffness, (B,)
    delay_ticks: NDArray[np.intp]  # from command to servo, (B,)
    friction: Floats  # of the floor, (B,)
    quality: Floats  # factor on the top speeds, (B,)

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


def put_rows(robots: object, rows: NDArray[np.intp], others: object) -> None:
    """Copy the fields of `others`, a dataclass of arrays of n robots, to the `rows` (n,) of `robots`."""
    for name, values in vars(others).items():
        getattr(robots, name)[rows] = values


@dataclass(frozen=True)
class WalkLimits:
    """Limits of the walk, from B-Human's published configuration for the V6 unless a field says otherwise."""

    forward_m_s: float = 0.250
    backward_m_s: float = 0.150
    sideways_m_s: float = 0.200
    turn_rad_s: float = float(np.radians(120.0))
    speed_up_m_s: float = 0.075  # forward speed that may be gained per step
    slow_down_m_s: float = 0.300  # forward speed that may be lost per step
    step_s: float = 0.250
    step_s_per_sideways_m_s: float = 0.150  # how much longer a step lasts per m/s sideways
    wide_turn: float = 0.67  # share of two steps' turn in the one that opens the feet; the rest closes them
    forward_stops_at_turn_rad: float = float(np.radians(24.0))
    """Turn in the wider step at which nothing is left of the forward speed, which falls with its square."""
    sideways_stops_at_turn_rad: float = float(np.radians(45.4))


LIMITS = WalkLimits()
STRIDE, START, STOP = 0, 1, 2  # kinds of steps: the first and the last step of a walk only shift the weight


@dataclass
class Gait:
    """Phases of B walking robots in their steps."""

    phase: Floats  # fraction of the step done, (B,)
    duration_s: Floats  # of the step, (B,)
    left_swings: Bools  # which foot is in the air, (B,)
    walking: Bools  # False for robots that stand, (B,)
    kind: NDArray[np.intp]  # of step: `STRIDE`, `START` or `STOP`, (B,)
    before: Floats  # spread at the step's start, (B, 3)
    after: Floats  # spread at the step's end, (B, 3)
    forward_m_s: Floats  # of the previous step, from which the next may differ by a limit, (B,)
    kicking: Bools  # whether the swinging foot kicks, (B,)

    @classmethod
    def standing(cls, count: int) -> "Gait":
        """Return `count` standing robots, whose first step is the left foot's."""
        return cls(
            phase=np.zeros(count),
            duration_s=np.full(count, LIMITS.step_s),
            left_swings=np.zeros(count, dtype=bool),
            walking=np.zeros(count, dtype=bool),
            kind=np.full(count, STOP),
            before=np.zeros((count, 3)),
            after=np.zeros((count, 3)),
            forward_m_s=np.zeros(count),
            kicking=np.zeros(count, dtype=bool),
        )

    def velocity(self) -> Floats:
        """Return the planned velocity of the torso during this step, m/s, m/s, rad/s, (B, 3)."""
        return np.asarray((self.before + self.after) / (2 * self.duration_s[:, None]))


@dataclass(frozen=True)
class WalkStyle:
    """Parameters of the motion; ours where no source is named."""

    hip_height_m: float = 0.230  # B-Human and HULKs
    lift_m: float = 0.022  # 13 mm at B-Human, 8 mm at HULKs; the servos here give way more
    torso_ahead_m: float = 0.012  # distance of the torso ahead of the middle of the ankles: B-Human
    sway_foot_m: float = 0.05  # distance of the foot of the sway's pendulum from the middle
    pendulum_m: float = 0.26  # length of the sway's pendulum, about the height of the center of mass
    step_scale: tuple[float, float, float] = (1.05, 1.3, 1.05)
    """Factors on steps (x, y, yaw) that make up for servos and slip; fitted to reach commands."""
    gyro_gain: tuple[float, float] = (0.08, 0.04)
    """Rad of ankle per rad/s of the torso, pitch and roll; 0.05 at B-Human and HULKs."""
    gyro_keep: float = 0.6  # decay of the low-pass filter on the rates per tick: B-Human
    lean_rad: float = 0.02  # the lift of a foot is delayed while the torso is about to lean farther over it than this
    lean_ahead_s: float = 0.06  # prediction horizon of the lean: about the delay of commands and servos
    longest_wait_ticks: int = 25
    kick_reach_m: float = 0.08  # distance that a kicking foot swings beyond its step


STYLE = WalkStyle()


@dataclass(frozen=True)
class Targets:
    """Targets of the legs for the next ticks."""

    angles: Floats  # in rad, (B, ticks, 11)
    supports: Bools  # feet that a walking robot stands on, left and right, (B, ticks, 2)
    lifts_off: NDArray[np.intp]  # foot that leaves the floor at the tick: 1 left, -1 right, 0 none, (B, ticks)
    gaits: list[Gait]  # before the first tick and after each, ticks + 1

    def reached(self, ticks: NDArray[np.intp]) -> Gait:
        """Return the gait of robots that followed `ticks` (B,) of them."""
        rows, gaits = np.arange(len(ticks)), [vars(gait) for gait in self.gaits]
        return Gait(**{name: np.stack([gait[name] for gait in gaits])[ticks, rows] for name in gaits[0]})


def attainable(command: Floats, quality: Floats) -> Floats:
    """Return `command` (B, 3), m/s, m/s, rad/s, reduced to what robots of a `quality` (B,) can walk, see `Traits`."""
    x, y, turn = command.T
    turn = np.clip(turn, -LIMITS.turn_rad_s * quality, LIMITS.turn_rad_s * quality)
    per_step = 2 * turn * LIMITS.step_s * LIMITS.wide_turn
    top_x = np.where(x > 0, LIMITS.forward_m_s, LIMITS.backward_m_s) * quality
    top_y = LIMITS.sideways_m_s * quality
    top_x = top_x * np.clip(1 - (per_step / LIMITS.forward_stops_at_turn_rad) ** 2, 0, 1)
    top_y = top_y * np.clip(1 - (per_step / LIMITS.sideways_stops_at_turn_rad) ** 2, 0, 1)
    x, y = np.clip(x, -top_x, top_x), np.clip(y, -top_y, top_y)
    share_x = np.divide(x, top_x, out=np.zeros_like(x), where=top_x > 0)
    share_y = np.divide(y, top_y, out=np.zeros_like(y), where=top_y > 0)
    excess = np.maximum(np.hypot(share_x, share_y), 1.0)
    x, y = x / excess, y / excess
    return np.stack([x, y, turn], axis=1)


def tick(gait: Gait, command: Floats, quality: Floats, on_the_spot: Bools) -> Bools:
    """Advance `gait`, planning steps by `command` (B, 3), none for zero but `on_the_spot`; return who began one."""
    gait.phase = np.where(gait.walking, gait.phase + TICK_S / gait.duration_s, 0.0)
    called = (command != 0).any(axis=1) | on_the_spot
    landed = gait.walking & (gait.phase >= 1)
    rests = landed & ~called & (gait.kind == STOP)
    begins = (landed & ~rests) | (~gait.walking & called)
    if landed.any() or begins.any():
        _plan(gait, attainable(command, quality), called, begins)
        gait.phase = np.where(landed, gait.phase - 1, gait.phase) * ~rests
        gait.walking = (gait.walking & ~rests) | begins
    return np.asarray(begins)


def _plan(gait: Gait, velocity: Floats, called: Bools, begins: Bools) -> None:
    x, y, turn = velocity.T
    x = _nearer_zero_or_up_to(gait.forward_m_s, x, LIMITS.slow_down_m_s, LIMITS.speed_up_m_s)
    closed = (gait.after == 0).all(axis=1)
    kind = np.where(gait.kind == STOP, START, np.where(closed & ~called, STOP, STRIDE))
    sideways = np.where(y != 0, y, turn)  # the first stride is that of the foot on the side that the command leads to
    left_swings = np.where((kind == START) & (sideways != 0), sideways < 0, ~gait.left_swings)
    leads_y, leads_turn = left_swings == (y > 0), left_swings == (turn > 0)
    duration = LIMITS.step_s + LIMITS.step_s_per_sideways_m_s * np.abs(y)
    turn_share = np.where(leads_turn, LIMITS.wide_turn, 1 - LIMITS.wide_turn)
    after = np.stack([x * duration, 2 * y * duration * leads_y, 2 * turn * duration * turn_share], axis=1)
    after *= (kind == STRIDE)[:, None]
    gait.before = np.where(begins[:, None], gait.after, gait.before)
    gait.after = np.where(begins[:, None], after, gait.after)
    gait.left_swings = np.where(begins, left_swings, gait.left_swings)
    gait.kind = np.where(begins, kind, gait.kind)
    gait.duration_s = np.where(begins, duration, gait.duration_s)
    gait.forward_m_s = np.where(begins, x * (kind == STRIDE), gait.forward_m_s)


def advance(gait: Gait, command: Floats, quality: Floats, ticks: int, kick: Bools) -> Targets:
    """Walk on at `command` (B, 3) for `ticks`, changing `gait`; feet that are to `kick` (B, 2) do in a swing."""
    feet, supports, lifts_off, gaits = [], [], [], [replace(gait)]
    steps_on = np.asarray(kick.any(axis=1))
    for _ in range(ticks):
        begins = tick(gait, command, quality, steps_on)
        kicks = np.where(gait.left_swings, kick[:, 0], kick[:, 1])
        gait.kicking = np.where(begins, kicks & (gait.kind == STRIDE), gait.kicking)
        feet.append(stance(gait))
        supports.append(gait.walking[:, None] & np.stack([~gait.left_swings, gait.left_swings], axis=1))
        lifts_off.append((begins & (gait.kind == STRIDE)) * np.where(gait.left_swings, 1, -1))
        gaits.append(replace(gait))
    return Targets(leg_angles(np.stack(feet, axis=1)), np.stack(supports, axis=1), np.stack(lifts_off, axis=1), gaits)


def stance(gait: Gait) -> Floats:
    """Return the present target poses of the feet in the torso's frame, (B, 2, 6), see `leg_angles`."""
    phase = gait.phase[:, None]
    scale = np.array(STYLE.step_scale) / 2
    behind, ahead = -gait.before * scale, gait.after * scale
    swung = (1 - np.cos(np.pi * phase)) / 2
    swinging = behind + (ahead - behind) * swung
    swinging[:, 0] += gait.kicking * STYLE.kick_reach_m * np.sin(np.pi * gait.phase) ** 2
    supporting = -behind - (ahead - behind) * phase
    offset = np.stack([supporting, swinging], axis=1)
    offset = np.where(gait.left_swings[:, None, None], offset[:, ::-1], offset)

    yaw, apart = offset[..., 2], np.array([HIP_OFFSET_Y_M, -HIP_OFFSET_Y_M])
    x, y = offset[..., 0], offset[..., 1] + apart
    pose = np.zeros((*yaw.shape, 6))
    pose[..., 0] = np.cos(yaw) * x - np.sin(yaw) * y - STYLE.torso_ahead_m
    pose[..., 1] = np.sin(yaw) * x + np.cos(yaw) * y - sway(gait)[:, None]
    pose[..., 2] = -STYLE.hip_height_m - HIP_OFFSET_Z_M
    lifted = gait.walking & (gait.kind == STRIDE)
    in_air = np.where(gait.left_swings, 0, 1)
    pose[np.arange(len(pose)), in_air, 2] += lifted * STYLE.lift_m * np.sin(np.pi * gait.phase)
    pose[..., 5] = yaw
    return pose


def sway(gait: Gait) -> Floats:
    """Return the torso's sway to the left, (B,) in m: an inverted pendulum on the supporting foot."""
    rate = np.sqrt(GRAVITY / STYLE.pendulum_m)
    done, left = gait.phase * gait.duration_s, (1 - gait.phase) * gait.duration_s
    foot = np.where(gait.left_swings, -1.0, 1.0) * STYLE.sway_foot_m
    half = STYLE.step_scale[1] / 2
    begin, end = foot + half * gait.before[:, 1], foot - half * gait.after[:, 1]
    straight = begin * (1 - gait.phase) + end * gait.phase
    swing = (begin * np.sinh(rate * left) + end * np.sinh(rate * done)) / np.sinh(rate * gait.duration_s)
    # In the first and the last step, from rest to the stride's speed and back.
    throw = foot * rate * np.tanh(rate * gait.duration_s / 2) * gait.duration_s
    rest = throw * gait.phase * (1 - gait.phase)
    shift = rest * np.where(gait.kind == START, gait.phase, 1 - gait.phase)
    return np.asarray(gait.walking * np.where(gait.kind == STRIDE, straight - swing, shift))


def _nearer_zero_or_up_to(speed: Floats, wanted: Floats, loss: float, gain: float) -> Floats:
    """Return `wanted` (B,), limited to `gain` away from zero and `loss` toward it from `speed` (B,)."""
    direction = np.where(speed != 0, np.sign(speed), np.sign(wanted))
    along = np.clip(wanted * direction, np.abs(speed) - loss, np.abs(speed) + gain)
    return np.asarray(direction * np.maximum(along, -gain))  # beyond zero the limit of a gain holds again
