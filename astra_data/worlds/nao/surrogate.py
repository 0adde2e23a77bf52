"""NAOs without physics: planned steps with delay, gains, scatter and slips. For tests and quick looks.

Level 1 of two stand-ins for the robot: the same planner as the walking robots of `worlds.nao.robot`, and
in place of legs, the gains and the scatter that a physical robot's log shows (published with Corrado et al.,
arXiv 2310.18247): 1.15 and 1.28 forward and sideways, 0.69 in turning.
"""

from dataclasses import dataclass
from typing import Any, override

import numpy as np
import torch
from numpy.typing import NDArray

from astra_data.worlds.nao.robot import CONTROL_STEP_S
from astra_data.worlds.nao.robots import Robots, Senses
from astra_data.worlds.nao.steps import Bools, Floats, Gait, StepPlanner, WalkLimits, put_rows
from astra_data.worlds.plane.ball import BALL_RADIUS_M, ROLLING_M_S2, kick_away, knock, roll
from astra_data.worlds.plane.free_space import FreeSpace
from astra_data.worlds.plane.geometry import wrapped
from astra_data.worlds.plane.mazes import Maze

BODY_RADIUS_M = 0.2
"""Of the disc that touches walls."""
_KICK_REACH_M = 0.22
"""Between the centres of a robot and a ball that it can kick."""
_KICK_WITHIN_RAD = float(np.radians(45.0))
"""Largest bearing of such a ball: feet swing forward."""


@dataclass(frozen=True)
class SurrogateVariation:
    """What sets robots apart, and what scatters from step to step."""

    gain: tuple[float, float, float] = (1.15, 1.28, 0.69)
    """Forward, sideways and turning speed over the planned."""
    gain_spread: tuple[float, float, float] = (0.1, 0.15, 0.08)
    """Standard deviations among robots."""
    quality: tuple[float, float] = (0.83, 1.0)
    """Factor on the top speeds, least and most."""
    drift_rad_s: float = float(np.radians(2.5))
    """Largest turning rate that a robot walking at 0.2 m/s adds; in proportion at other speeds."""
    scatter_m: float = 0.018
    """Standard deviation of a step's landing, per axis."""
    scatter_rad: float = float(np.radians(3.5))
    """Of its heading."""
    slip: float = 0.05
    """Probability that a step slips, and so loses up to 0.4 of its length or more."""
    delay_steps: float = 0.6
    """Control steps from a command to the planner."""
    knock_m_s: tuple[float, float] = (0.45, 0.95)
    """Speed of a ball that is walked into."""
    kick_m_s: tuple[float, float] = (0.4, 1.2)
    """Speed of a ball that is kicked."""
    knock_rad: float = float(np.radians(15.0))
    """Standard deviation of the direction of both."""


@dataclass
class _Robots:
    pose: Floats
    velocity: Floats
    sent: Floats
    gain: Floats
    quality: Floats
    drift: Floats
    ball: Floats
    ball_velocity: Floats
    touching: Bools


class SurrogateNao(Robots):
    """B NAOs reduced to their steps; a stand-in for `BatchedNao` that never falls."""

    def __init__(
        self,
        num_robots: int,
        *,
        seed: int,
        maze: Maze | None = None,
        ball: bool = False,
        variation: SurrogateVariation | None = None,
        num_threads: int | None = None,
    ) -> None:
        """Build B robots that stand at the origin.

        Args:
            num_robots: B.
            seed: of everything that scatters.
            maze: walls, by default none.
            ball: give each robot a ball.
            variation: what scatters.
            num_threads: without effect: nothing here is worth a thread.
        """
        del num_threads
        self.num_robots, self.has_ball = num_robots, ball
        self.variation = variation or SurrogateVariation()
        self._limits = WalkLimits()
        self._free = None if maze is None else FreeSpace.of_maze(maze, radius_m=BODY_RADIUS_M)
        self._seed, self._steps = seed, 0
        self.gait = Gait.standing(num_robots, self._limits)
        zeros = np.zeros
        self._robots = _Robots(
            pose=zeros((num_robots, 3)),
            velocity=zeros((num_robots, 3)),
            sent=zeros((num_robots, 3)),
            gain=np.ones((num_robots, 3)),
            quality=np.ones(num_robots),
            drift=zeros(num_robots),
            ball=zeros((num_robots, 2)),
            ball_velocity=zeros((num_robots, 2)),
            touching=zeros(num_robots, dtype=bool),
        )
        self.reset(np.arange(num_robots), zeros((num_robots, 3)), np.random.default_rng(seed))

    def reset(
        self,
        rows: NDArray[np.intp],
        poses: Floats,
        rng: np.random.Generator,
        ball: Floats | None = None,
    ) -> None:
        """Stand the robots `rows` (n,) at `poses` (n, 3) with new traits, their balls at `ball` (n, 2)."""
        count, varied, robots = len(rows), self.variation, self._robots
        standing = Gait.standing(count, self._limits)
        put_rows(self.gait, rows, standing)
        robots.pose[rows] = poses
        robots.velocity[rows] = robots.sent[rows] = 0.0
        robots.gain[rows] = np.maximum(rng.normal(varied.gain, varied.gain_spread, (count, 3)), 0.1)
        robots.quality[rows] = rng.uniform(*varied.quality, count)
        robots.drift[rows] = rng.uniform(-varied.drift_rad_s, varied.drift_rad_s, count)
        robots.ball[rows] = poses[:, :2] + [1.0, 0.0] if ball is None else ball
        robots.ball_velocity[rows] = 0.0
        robots.touching[rows] = False

    def step(self, command: Floats, active: Bools | None = None, kick: Bools | None = None) -> None:
        """Walk for one control step of 0.192 s: forward and left in m/s, turn in rad/s, (B, 3).

        Rows outside `active` (B,) stay as they are. Whoever walks into a ball knocks it away; those in `kick`
        (B,) kick it where they can reach it.
        """
        robots, varied = self._robots, self.variation
        rows = np.flatnonzero(np.ones(self.num_robots, dtype=bool) if active is None else active)
        rng = np.random.default_rng([self._seed, self._steps])
        self._steps += 1
        late = varied.delay_steps * robots.sent + (1 - varied.delay_steps) * command
        gait = Gait(**{name: value.copy() for name, value in vars(self.gait).items()})
        StepPlanner(robots.quality, self._limits).advance(gait, late, CONTROL_STEP_S, kick)
        shape = (self.num_robots, 3)
        share = np.sqrt(CONTROL_STEP_S / self._limits.step_s)
        scatter = np.array([varied.scatter_m, varied.scatter_m, varied.scatter_rad]) * share
        scattered = scatter * rng.normal(size=shape) * gait.walking[:, None]
        slips = np.where(rng.random(self.num_robots) < varied.slip, rng.uniform(0, 0.6, self.num_robots), 1.0)
        velocity = gait.velocity() * robots.gain
        velocity[:, :2] *= slips[:, None]
        velocity[:, 2] += robots.drift * np.hypot(velocity[:, 0], velocity[:, 1]) / 0.2
        motion = velocity * CONTROL_STEP_S + scattered
        heading = robots.pose[:, 2] + motion[:, 2] / 2
        cos, sin = np.cos(heading), np.sin(heading)
        way = np.stack(
            [cos * motion[:, 0] - sin * motion[:, 1], sin * motion[:, 0] + cos * motion[:, 1]], axis=1
        )
        before = robots.pose[:, :2].copy()
        after, touching = before + way, np.zeros(self.num_robots, dtype=bool)
        if self._free is not None:
            slid, stopped = self._free.slide(torch.from_numpy(before), torch.from_numpy(after))
            after, touching = slid.numpy(), stopped.numpy()
        ball, rolling = self._ball_after(before, after, kick, rng)
        world = np.concatenate([(after - before) / CONTROL_STEP_S, motion[:, 2:] / CONTROL_STEP_S], axis=1)
        turned = robots.pose[:, 2:] + motion[:, 2:]
        self._put(rows, gait, np.concatenate([after, turned], axis=1), world, touching, ball, rolling)
        robots.sent[rows] = command[rows]

    def _ball_after(
        self, before: Floats, after: Floats, kicks: Bools | None, rng: np.random.Generator
    ) -> tuple[Floats, Floats]:
        varied, robots = self.variation, self._robots
        tensors = [torch.from_numpy(v) for v in (before, after, robots.ball, robots.ball_velocity)]
        turn = torch.from_numpy(varied.knock_rad * rng.normal(size=self.num_robots))
        knocked, kicked = (
            torch.from_numpy(rng.uniform(*speeds, self.num_robots)).unsqueeze(-1)
            for speeds in (varied.knock_m_s, varied.kick_m_s)
        )
        ball, rolling = knock(*tensors, reach_m=0.14 + BALL_RADIUS_M, speed_m_s=knocked, turn_rad=turn)
        if kicks is not None:
            apart = robots.ball - after
            bearing = wrapped(np.arctan2(apart[:, 1], apart[:, 0]) - robots.pose[:, 2])
            asked = torch.from_numpy(kicks & (np.abs(bearing) <= _KICK_WITHIN_RAD)).unsqueeze(-1)
            rolling = kick_away(
                tensors[1], ball, rolling, asked, reach_m=_KICK_REACH_M, speed_m_s=kicked, turn_rad=turn
            )
        ball, rolling = roll(ball, rolling, CONTROL_STEP_S, ROLLING_M_S2)
        return ball.numpy(), rolling.numpy()

    def _put(
        self,
        rows: NDArray[np.intp],
        gait: Gait,
        pose: Floats,
        velocity: Floats,
        touching: Bools,
        ball: Floats,
        rolling: Floats,
    ) -> None:
        for name, value in vars(gait).items():
            getattr(self.gait, name)[rows] = value[rows]
        robots = self._robots
        robots.pose[rows], robots.velocity[rows] = pose[rows], velocity[rows]
        robots.ball[rows], robots.ball_velocity[rows] = ball[rows], rolling[rows]
        robots.touching[rows] = touching[rows]

    @property
    @override
    def fallen(self) -> Bools:
        return np.zeros(self.num_robots, dtype=bool)

    @property
    @override
    def touching(self) -> Bools:
        return self._robots.touching

    @property
    @override
    def pose(self) -> Floats:
        return self._robots.pose

    @property
    @override
    def velocity(self) -> Floats:
        return self._robots.velocity

    @property
    @override
    def ball(self) -> Floats:
        return self._robots.ball

    @property
    @override
    def ball_velocity(self) -> Floats:
        return self._robots.ball_velocity

    @property
    @override
    def senses(self) -> Senses:
        # Legs and feet feel nothing.
        count = self.num_robots
        gyro = np.zeros((count, 3))
        gyro[:, 2] = self._robots.velocity[:, 2]
        return Senses(
            angles=np.zeros((count, 11)),
            gyro=gyro,
            tilt=np.zeros((count, 2)),
            pressure=np.zeros((count, 2, 4)),
            phase=self.gait.phase.copy(),
            left_swings=self.gait.left_swings.copy(),
            planned=self.gait.velocity(),
        )

    @override
    def _arrays(self) -> dict[str, NDArray[Any]]:
        return vars(self.gait) | vars(self._robots)
