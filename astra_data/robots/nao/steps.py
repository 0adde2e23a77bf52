"""Step planning of a walking NAO: commanded velocities in, landing positions of the feet out. No physics.

A step lasts from one landing to the next. When the swinging foot lands, it is half of the step's *spread*
ahead of its place at rest beneath the torso, the supporting foot half of it behind; spread is (x, y, yaw) in
m, m, rad. During a step, the torso therefore moves by the mean of the spreads before and after.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats


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
    speed_up_m_s: float = 0.075
    """Forward speed that may be gained per step."""
    slow_down_m_s: float = 0.300
    """Forward speed that may be lost per step."""
    step_s: float = 0.250
    step_s_per_sideways_m_s: float = 0.150
    """How much longer a step lasts per m/s sideways."""
    wide_turn: float = 0.67
    """Share of two steps' turn in the one that opens the feet; the rest closes them."""
    forward_stops_at_turn_rad: float = float(np.radians(24.0))
    """Turn in the wider step at which nothing is left of the forward speed, which falls with its square."""
    sideways_stops_at_turn_rad: float = float(np.radians(45.4))


STRIDE, START, STOP = 0, 1, 2
"""Kinds of steps: the first and the last step of a walk only shift the weight."""


@dataclass
class Gait:
    """Phases of B walking robots in their steps.

    Attributes:
        phase: fraction of the step done, (B,).
        duration_s: of the step, (B,).
        left_swings: which foot is in the air, (B,) bool.
        walking: False for robots that stand, (B,) bool.
        kind: of step: `STRIDE`, `START` or `STOP`, (B,) int.
        before, after: spread at the step's start and end, (B, 3).
        forward_m_s: forward speed of the previous step, from which the next may differ by a limit, (B,).
        kicking: whether the swinging foot kicks, (B,) bool.
    """

    phase: Floats
    duration_s: Floats
    left_swings: Bools
    walking: Bools
    kind: NDArray[np.intp]
    before: Floats
    after: Floats
    forward_m_s: Floats
    kicking: Bools

    @classmethod
    def standing(cls, count: int, limits: WalkLimits) -> "Gait":
        """Return `count` standing robots, whose first step is the left foot's."""
        return cls(
            phase=np.zeros(count),
            duration_s=np.full(count, limits.step_s),
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
class StepPlanner:
    """Plans the steps of B robots.

    Attributes:
        quality: factor on a robot's top speeds, (B,): 1 new, 0.83 worn (B-Human's two sets of limits).
        limits: top speeds and the rest.
    """

    quality: Floats
    limits: WalkLimits = field(default_factory=WalkLimits)

    def attainable(self, command: Floats) -> Floats:
        """Return `command` (B, 3), m/s, m/s, rad/s, reduced to velocities that can be walked, (B, 3)."""
        limits, quality = self.limits, self.quality
        x, y, turn = command.T
        turn = np.clip(turn, -limits.turn_rad_s * quality, limits.turn_rad_s * quality)
        per_step = 2 * turn * limits.step_s * limits.wide_turn
        top_x = np.where(x > 0, limits.forward_m_s, limits.backward_m_s) * quality
        top_y = limits.sideways_m_s * quality
        top_x = top_x * np.clip(1 - (per_step / limits.forward_stops_at_turn_rad) ** 2, 0, 1)
        top_y = top_y * np.clip(1 - (per_step / limits.sideways_stops_at_turn_rad) ** 2, 0, 1)
        x, y = np.clip(x, -top_x, top_x), np.clip(y, -top_y, top_y)
        share_x = np.divide(x, top_x, out=np.zeros_like(x), where=top_x > 0)
        share_y = np.divide(y, top_y, out=np.zeros_like(y), where=top_y > 0)
        excess = np.maximum(np.hypot(share_x, share_y), 1.0)
        x, y = x / excess, y / excess
        return np.stack([x, y, turn], axis=1)

    def advance(self, gait: Gait, command: Floats, seconds: float, on_the_spot: Bools | None = None) -> Bools:
        """Advance `gait` by `seconds`, in place; where a step ends, plan the next one by `command` (B, 3).

        With a command of zero robots come to rest, except those that walk `on_the_spot` (B,).

        Returns:
            Which robots began a step, (B,) bool.
        """
        gait.phase = np.where(gait.walking, gait.phase + seconds / gait.duration_s, 0.0)
        called = (command != 0).any(axis=1)
        if on_the_spot is not None:
            called |= on_the_spot
        landed = gait.walking & (gait.phase >= 1)
        rests = landed & ~called & (gait.kind == STOP)
        begins = (landed & ~rests) | (~gait.walking & called)
        if landed.any() or begins.any():
            self._plan(gait, command, called, begins)
            gait.phase = np.where(landed, gait.phase - 1, gait.phase) * ~rests
            gait.walking = (gait.walking & ~rests) | begins
        return np.asarray(begins)

    def _plan(self, gait: Gait, command: Floats, called: Bools, begins: Bools) -> None:
        limits = self.limits
        x, y, turn = self.attainable(command).T
        x = _nearer_zero_or_up_to(gait.forward_m_s, x, limits.slow_down_m_s, limits.speed_up_m_s)
        closed = (gait.after == 0).all(axis=1)
        kind = np.where(gait.kind == STOP, START, np.where(closed & ~called, STOP, STRIDE))
        # The first stride is that of the foot on the side that the command leads to.
        sideways = np.where(y != 0, y, turn)
        left_swings = np.where((kind == START) & (sideways != 0), sideways < 0, ~gait.left_swings)
        leads_y, leads_turn = left_swings == (y > 0), left_swings == (turn > 0)
        duration = limits.step_s + limits.step_s_per_sideways_m_s * np.abs(y)
        turn_share = np.where(leads_turn, limits.wide_turn, 1 - limits.wide_turn)
        after = np.stack([x * duration, 2 * y * duration * leads_y, 2 * turn * duration * turn_share], axis=1)
        after *= (kind == STRIDE)[:, None]
        gait.before = np.where(begins[:, None], gait.after, gait.before)
        gait.after = np.where(begins[:, None], after, gait.after)
        gait.left_swings = np.where(begins, left_swings, gait.left_swings)
        gait.kind = np.where(begins, kind, gait.kind)
        gait.duration_s = np.where(begins, duration, gait.duration_s)
        gait.forward_m_s = np.where(begins, x * (kind == STRIDE), gait.forward_m_s)


def _nearer_zero_or_up_to(speed: Floats, wanted: Floats, loss: float, gain: float) -> Floats:
    """Return `wanted` (B,), limited to `gain` away from zero and `loss` toward it from `speed` (B,)."""
    direction = np.where(speed != 0, np.sign(speed), np.sign(wanted))
    along = np.clip(wanted * direction, np.abs(speed) - loss, np.abs(speed) + gain)
    # Beyond zero the limit of a gain holds again.
    return np.asarray(direction * np.maximum(along, -gain))
