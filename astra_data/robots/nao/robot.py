"""B walking NAOs: commanded velocities in, sensor readings and true poses out."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.core.provenance import cores
from astra_data.robots.nao.bodies import MOTORS, TICKS, BatchedBodies, nao_model
from astra_data.robots.nao.kicking import BALL_RADIUS_M
from astra_data.robots.nao.kinematics import (
    HIP_OFFSET_Z_M,
    TICK_S,
    TO_MOTORS,
    Traits,
    TraitSpread,
    leg_angles,
)
from astra_data.robots.nao.walk import Gait, StepPlanner, WalkEngine, WalkLimits, WalkStyle, put_rows
from astra_data.worlds.geometry import rotation_matrix
from astra_data.worlds.plane.mazes import Maze

CONTROL_STEP_S = TICKS * TICK_S
_BALL = 7 + MOTORS
_MIDDLE_M = 0.03
"""Either foot may kick a ball that is less far to the side: the torso sways as far from step to step."""


class BatchedNao:
    """B NAOs, each on a floor of its own.

    Attributes:
        gait: the robots' phases in their steps. traits: individual differences of the robots. bodies: their
        physics.
    """

    def __init__(
        self,
        num_robots: int,
        *,
        seed: int,
        maze: Maze | None = None,
        ball: bool = False,
        spread: TraitSpread | None = None,
        num_threads: int | None = None,
    ) -> None:
        """Build B robots standing at the origin.

        ball: give each robot a ball. spread: ranges of the traits.
        """
        self.num_robots = num_robots
        self.spread = spread or TraitSpread()
        self.has_ball = ball
        self._limits, style = WalkLimits(), WalkStyle()
        self._seed, self._steps = seed, 0
        rng = np.random.default_rng(seed)
        self.traits = Traits.draw(self.spread, num_robots, rng)
        self.gait = Gait.standing(num_robots, self._limits)
        self._engine = WalkEngine(StepPlanner(self.traits.quality, self._limits), style)
        self.bodies = BatchedBodies(
            nao_model(maze, ball=ball),
            self.traits,
            longest_delay_ticks=self.spread.delay_ticks[1],
            style=style,
            num_threads=num_threads or cores(),
        )
        self.reset(np.arange(num_robots), np.zeros((num_robots, 3)), rng)

    def reset(
        self, rows: NDArray[np.intp], poses: Floats, rng: np.random.Generator, ball: Floats | None = None
    ) -> None:
        """Set the robots `rows` (n,) upright at `poses` (n, 3), x, y in m and heading, with new traits.

        Their balls are put at `ball` (n, 2) in m, by default 1 m ahead of them.
        """
        put_rows(self.traits, rows, Traits.draw(self.spread, len(rows), rng))
        standing = Gait.standing(len(rows), self._limits)
        put_rows(self.gait, rows, standing)
        angles = leg_angles(self._engine.feet(standing))
        x, y, yaw = poses.T
        qpos = np.tile(self.bodies.model.qpos0, (len(rows), 1))
        qpos[:, 0], qpos[:, 1] = x, y
        qpos[:, 2] = self._engine.style.hip_height_m + HIP_OFFSET_Z_M
        qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
        qpos[:, 7:_BALL] = angles[:, TO_MOTORS]
        if self.has_ball:
            ahead = np.stack([x + np.cos(yaw), y + np.sin(yaw)], axis=1)
            qpos[:, _BALL : _BALL + 2] = ahead if ball is None else ball
            qpos[:, _BALL + 2] = BALL_RADIUS_M
        self.bodies.reset(rows, qpos, (angles + self.traits.joint_offset_rad[rows])[:, TO_MOTORS])

    def step(self, command: Floats, active: Bools | None = None, kick: Bools | None = None) -> None:
        """Walk for one control step of 0.192 s.

        Args:
            command: velocities forward and to the left in m/s, turn in rad/s, (B, 3).
            active: which robots move, (B,); all others, and fallen ones, stay as they are.
            kick: which robots kick with the foot on the ball's side when it next swings, (B,).
        """
        rows = np.flatnonzero(~self.fallen if active is None else active & ~self.fallen)
        targets = self._engine.advance(replace(self.gait), command, TICKS, self._kicking_feet(kick))
        noise = np.random.default_rng([self._seed, self._steps]).normal(
            0.0, self.spread.gyro_noise_rad_s, (self.num_robots, TICKS, 3)
        )
        self._steps += 1
        self.gait = targets.reached(self.bodies.step(rows, targets, noise))

    def reseed(self, seed: int) -> None:
        """Restart the noise of the sensors at `seed`."""
        self._seed, self._steps = seed, 0

    def _kicking_feet(self, kick: Bools | None) -> Bools | None:
        if kick is None or not self.has_ball:
            return None
        x, y = (self.ball - self.pose[:, :2]).T
        yaw = self.pose[:, 2]
        to_the_left = np.cos(yaw) * y - np.sin(yaw) * x
        sides = np.stack([to_the_left > -_MIDDLE_M, to_the_left < _MIDDLE_M], axis=1)
        return np.asarray(kick[:, None] & sides)

    @property
    def fallen(self) -> Bools:
        """Which robots lie on the floor, (B,)."""
        return self.bodies.fallen

    @property
    def touching(self) -> Bools:
        """Which robots touched a wall in their last control step, (B,)."""
        return self.bodies.touching

    @property
    def pose(self) -> Floats:
        """True x, y of the torsos in m and their heading in rad, (B, 3)."""
        rotation = rotation_matrix(self.bodies.qpos[:, 3:7])
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        return np.concatenate([self.bodies.qpos[:, :2], yaw[:, None]], axis=1)

    @property
    def velocity(self) -> Floats:
        """True velocity of the torsos on the floor, x, y in m/s, turn in rad/s, (B, 3)."""
        turn = np.einsum(
            "bi,bi->b", rotation_matrix(self.bodies.qpos[:, 3:7])[:, 2], self.bodies.qvel[:, 3:6]
        )
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

    def state_dict(self) -> dict[str, Any]:
        """Return copies of what `load_state_dict` needs to continue exactly from here."""
        noise = {"seed": self._seed, "steps": self._steps}
        return {name: value.copy() for name, value in self._arrays().items()} | noise

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state` of robots that were built with the same arguments."""
        for name, value in self._arrays().items():
            value[:] = state[name]
        self._seed, self._steps = int(state.get("seed", self._seed)), int(state["steps"])

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that change from step to step, by name."""
        bodies = self.bodies
        parts = ("state", "sent", "held", "waited", "tilting", "gyro", "pressure", "fallen", "touching")
        own = {name: getattr(bodies, name) for name in parts}
        return own | vars(self.gait) | vars(self.traits)
