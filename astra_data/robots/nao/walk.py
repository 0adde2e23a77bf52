"""The NAO's walk engine: commanded velocities in, joint angles of the planned steps out.

In the style of Walk2014 (Hengst, UNSW 2014): the supporting foot moves back at constant speed beneath a torso
of constant height, the swinging foot moves forward and is lifted; the torso sways over the supporting foot
like a linear inverted pendulum. Angles do not depend on sensors, so many ticks are planned at once; only the
ankles are corrected by the gyroscope when the angles are sent (`worlds.nao.bodies`).
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.robots.nao.body import GRAVITY, TICK_S
from astra_data.robots.nao.kinematics import leg_angles
from astra_data.robots.nao.links import HIP_OFFSET_Y_M, HIP_OFFSET_Z_M
from astra_data.robots.nao.steps import START, STRIDE, Gait, StepPlanner


@dataclass(frozen=True)
class WalkStyle:
    """Parameters of the motion; ours where no source is named."""

    hip_height_m: float = 0.230
    """B-Human and HULKs."""
    lift_m: float = 0.022
    """13 mm at B-Human, 8 mm at HULKs; the servos here give way more."""
    torso_ahead_m: float = 0.012
    """Distance of the torso ahead of the middle of the ankles: B-Human."""
    sway_foot_m: float = 0.05
    """Distance of the foot of the sway's pendulum from the middle."""
    pendulum_m: float = 0.26
    """Length of the sway's pendulum, about the height of the center of mass."""
    step_scale: tuple[float, float, float] = (1.05, 1.3, 1.05)
    """Factors on steps (x, y, yaw) that make up for servos and slip; fitted to reach commands."""
    gyro_gain: tuple[float, float] = (0.08, 0.04)
    """Rad of ankle per rad/s of the torso, pitch and roll; 0.05 at B-Human and HULKs."""
    gyro_keep: float = 0.6
    """Decay of the low-pass filter on the rates per tick: B-Human."""
    lean_rad: float = 0.02
    """The lift of a foot is delayed while the torso is about to lean farther over it than this."""
    lean_ahead_s: float = 0.06
    """Prediction horizon of the lean: about the delay of commands and servos."""
    longest_wait_ticks: int = 25
    kick_reach_m: float = 0.08
    """Distance that a kicking foot swings beyond its step."""


@dataclass(frozen=True)
class Targets:
    """Targets of the legs for the next ticks.

    Attributes:
        angles: the eleven angles, (B, ticks, 11) in rad.
        supports: feet that a walking robot stands on, left and right, (B, ticks, 2) bool.
        lifts_off: foot that leaves the floor at the tick: 1 left, -1 right, 0 none, (B, ticks).
        gaits: the gait before the first tick and after each, ticks + 1.
    """

    angles: Floats
    supports: Bools
    lifts_off: NDArray[np.intp]
    gaits: list[Gait]

    def reached(self, ticks: NDArray[np.intp]) -> Gait:
        """Return the gait of robots that followed `ticks` (B,) of them."""
        parts = {
            part.name: np.stack([getattr(gait, part.name) for gait in self.gaits])[
                ticks, np.arange(len(ticks))
            ]
            for part in fields(Gait)
        }
        return Gait(**parts)


@dataclass(frozen=True)
class WalkEngine:
    """Walks B robots.

    Attributes:
        planner: plans their steps.
        style: how their feet move.
    """

    planner: StepPlanner
    style: WalkStyle

    def advance(self, gait: Gait, command: Floats, ticks: int, kick: Bools | None = None) -> Targets:
        """Walk on for `ticks` of 12 ms, changing `gait` in place.

        Args:
            gait: the robots' phases in their steps.
            command: velocities, m/s forward, m/s to the left, rad/s, (B, 3).
            ticks: how many.
            kick: feet, left and right, that kick when they swing next, (B, 2), by default none. Robots that
                are to kick keep stepping.
        """
        feet, supports, lifts_off, gaits = [], [], [], [replace(gait)]
        if kick is None:
            kick = np.zeros((len(command), 2), dtype=bool)
        steps_on = np.asarray(kick.any(axis=1))
        for _ in range(ticks):
            begins = self.planner.advance(gait, command, TICK_S, steps_on)
            kicks = np.where(gait.left_swings, kick[:, 0], kick[:, 1])
            gait.kicking = np.where(begins, kicks & (gait.kind == STRIDE), gait.kicking)
            feet.append(self.feet(gait))
            supports.append(gait.walking[:, None] & np.stack([~gait.left_swings, gait.left_swings], axis=1))
            lifts_off.append((begins & (gait.kind == STRIDE)) * np.where(gait.left_swings, 1, -1))
            gaits.append(replace(gait))
        return Targets(
            leg_angles(np.stack(feet, axis=1)).angles,
            np.stack(supports, axis=1),
            np.stack(lifts_off, axis=1),
            gaits,
        )

    def feet(self, gait: Gait) -> Floats:
        """Return the present target poses of the feet in the torso's frame, (B, 2, 6), see `foot_poses`."""
        style, phase = self.style, gait.phase[:, None]
        scale = np.array(style.step_scale) / 2
        behind, ahead = -gait.before * scale, gait.after * scale
        swung = (1 - np.cos(np.pi * phase)) / 2
        swinging = behind + (ahead - behind) * swung
        swinging[:, 0] += gait.kicking * style.kick_reach_m * np.sin(np.pi * gait.phase) ** 2
        supporting = -behind - (ahead - behind) * phase
        offset = np.stack([supporting, swinging], axis=1)
        left = gait.left_swings.astype(np.intp)
        offset = np.stack(
            [offset[np.arange(len(left)), left], offset[np.arange(len(left)), 1 - left]], axis=1
        )

        yaw, apart = offset[..., 2], np.array([HIP_OFFSET_Y_M, -HIP_OFFSET_Y_M])
        x, y = offset[..., 0], offset[..., 1] + apart
        pose = np.zeros((len(left), 2, 6))
        pose[..., 0] = np.cos(yaw) * x - np.sin(yaw) * y - style.torso_ahead_m
        pose[..., 1] = np.sin(yaw) * x + np.cos(yaw) * y - self._sway(gait)[:, None]
        pose[..., 2] = -style.hip_height_m - HIP_OFFSET_Z_M
        lifted = gait.walking & (gait.kind == STRIDE)
        pose[np.arange(len(left)), 1 - left, 2] += lifted * style.lift_m * np.sin(np.pi * gait.phase)
        pose[..., 5] = yaw
        return pose

    def _sway(self, gait: Gait) -> Floats:
        """Return the sway of the torso to the left of a straight line from start to end, (B,) in m.

        It moves like an inverted pendulum on the supporting foot, with the speed that takes it from start to
        end within the step.
        """
        rate = np.sqrt(GRAVITY / self.style.pendulum_m)
        done, left = gait.phase * gait.duration_s, (1 - gait.phase) * gait.duration_s
        foot = np.where(gait.left_swings, -1.0, 1.0) * self.style.sway_foot_m
        half = self.style.step_scale[1] / 2
        begin, end = foot + half * gait.before[:, 1], foot - half * gait.after[:, 1]
        straight = begin * (1 - gait.phase) + end * gait.phase
        swing = (begin * np.sinh(rate * left) + end * np.sinh(rate * done)) / np.sinh(rate * gait.duration_s)
        # In the first and the last step, from rest to the stride's speed and back.
        throw = foot * rate * np.tanh(rate * gait.duration_s / 2) * gait.duration_s
        rest = throw * gait.phase * (1 - gait.phase)
        shift = rest * np.where(gait.kind == START, gait.phase, 1 - gait.phase)
        return np.asarray(gait.walking * np.where(gait.kind == STRIDE, straight - swing, shift))
