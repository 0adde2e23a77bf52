"""A NAO's estimates of its own pose and of the ball. Batched numpy, no physics."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.worlds.geometry import wrapped


@dataclass(frozen=True)
class PerceptionErrors:
    """Errors of the estimates; all can be zero."""

    white_m: float = 0.005  # standard deviation of the position's error from step to step
    drift_m: float = 0.03  # standard deviation, per axis, of the part that drifts
    drift_rad: float = float(np.radians(2.0))  # of the heading, likewise
    drift_s: float = 2.0  # time constant of both
    jumps_per_s: float = 5 / 60  # rate at which the estimated position jumps; the error then decays like the drift
    jump_m: tuple[float, float] = (0.1, 0.3)  # range of the distance of a jump
    latency_s: float = 0.067  # age of an estimate: half of the camera's period of 33 ms, and 50 ms of processing
    ball_m: float = 0.012  # standard deviation, per axis, of the ball's position at the robot's feet
    ball_m_per_m: float = 0.033  # its increase per meter of distance
    ball_most_m: float = 0.106  # its upper limit
    ball_s: float = 0.5  # time constant of the ball's error
    ball_missed: float = 0.1  # probability that a ball in view is not seen in a step
    ball_seen_rad: float = float(np.radians(100.0))
    """Largest bearing at which a ball is seen: the head turns by 68 degrees, the camera sees 28 more."""
    ball_speed_keep: float = 0.6  # weight of the previous estimate of the ball's velocity when the ball is seen again


class Localisation:
    """Estimated poses of B robots: x, y in m and heading in rad."""

    def __init__(self, num_robots: int, errors: PerceptionErrors, step_s: float) -> None:
        self.errors, self.step_s = errors, step_s
        self.pose: Floats = np.zeros((num_robots, 3))
        self._drift: Floats = np.zeros((num_robots, 3))
        self._true: Floats = np.zeros((num_robots, 3))

    def reset(self, rows: NDArray[np.intp], pose: Floats, rng: np.random.Generator) -> None:
        """Restart `rows` (n,) at the true `pose` (n, 3), with an error of the usual size."""
        errors = self.errors
        spread = np.array([errors.drift_m, errors.drift_m, errors.drift_rad])
        self._drift[rows] = spread * rng.normal(size=(len(rows), 3))
        self._true[rows] = pose
        self.pose[rows] = pose + self._drift[rows]

    def update(self, pose: Floats, rng: np.random.Generator, active: Bools) -> None:
        """Update the estimates of the robots in `active` (B,) after a step to the true `pose` (B, 3)."""
        errors, count = self.errors, len(pose)
        keep = np.exp(-self.step_s / errors.drift_s)
        spread = np.array([errors.drift_m, errors.drift_m, errors.drift_rad])
        drift = keep * self._drift + np.sqrt(1 - keep**2) * spread * rng.normal(size=(count, 3))
        jumps = rng.random(count) < errors.jumps_per_s * self.step_s
        way = rng.uniform(*errors.jump_m, count) * jumps
        angle = rng.uniform(-np.pi, np.pi, count)
        drift[:, :2] += way[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        white = errors.white_m * rng.normal(size=(count, 2))
        motion = pose - self._true
        motion[:, 2] = wrapped(motion[:, 2])
        estimated = pose - motion * (errors.latency_s / self.step_s) + drift
        estimated[:, :2] += white
        estimated[:, 2] = wrapped(estimated[:, 2])
        self.pose = np.where(active[:, None], estimated, self.pose)
        self._drift = np.where(active[:, None], drift, self._drift)
        self._true = np.where(active[:, None], pose, self._true)

    def arrays(self) -> dict[str, Floats]:
        """Return the arrays that later estimates depend on, themselves."""
        return {"believed": self.pose, "believed_drift": self._drift, "believed_of": self._true}


class BallSight:
    """Estimates of B robots of their balls, in the world frame."""

    def __init__(self, num_robots: int, errors: PerceptionErrors, step_s: float) -> None:
        self.errors, self.step_s = errors, step_s
        self.position: Floats = np.zeros((num_robots, 2))
        self.velocity: Floats = np.zeros((num_robots, 2))
        self.unseen_s: Floats = np.zeros(num_robots)
        self._error: Floats = np.zeros((num_robots, 2))

    def reset(self, rows: NDArray[np.intp], ball: Floats) -> None:
        """Restart `rows` (n,) with the exact positions of the balls, (n, 2)."""
        self.position[rows] = ball
        self.velocity[rows] = 0.0
        self.unseen_s[rows] = 0.0
        self._error[rows] = 0.0

    def update(self, ball: Floats, pose: Floats, estimated: Floats, rng: np.random.Generator, active: Bools) -> None:
        """Update the robots in `active` (B,) after a step to the true `ball` (B, 2); `pose` is true, (B, 3)."""
        errors = self.errors
        apart = ball - pose[:, :2]
        distance = np.linalg.norm(apart, axis=1)
        bearing = wrapped(np.arctan2(apart[:, 1], apart[:, 0]) - pose[:, 2])
        seen = (rng.random(len(ball)) >= errors.ball_missed) & (np.abs(bearing) <= errors.ball_seen_rad)
        spread = np.minimum(errors.ball_m + errors.ball_m_per_m * distance, errors.ball_most_m)
        keep = np.exp(-self.step_s / errors.ball_s)
        fresh = np.sqrt(1 - keep**2) * spread[:, None] * rng.normal(size=ball.shape)
        self._error = np.where(active[:, None], keep * self._error + fresh, self._error)
        angle = bearing + estimated[:, 2]
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        place = estimated[:, :2] + distance[:, None] * direction + self._error
        since = (self.unseen_s + self.step_s)[:, None]
        fast = (place - self.position) / since
        mixed = errors.ball_speed_keep * self.velocity + (1 - errors.ball_speed_keep) * fast
        taken = (seen & active)[:, None]
        self.velocity = np.where(taken, mixed, self.velocity)
        self.position = np.where(taken, place, self.position)
        self.unseen_s = np.where(active, np.where(seen, 0.0, self.unseen_s + self.step_s), self.unseen_s)

    def arrays(self) -> dict[str, Floats]:
        """Return the arrays that later estimates depend on, themselves."""
        return {
            "seen_ball": self.position,
            "seen_ball_velocity": self.velocity,
            "seen_ball_since": self.unseen_s,
            "seen_ball_error": self._error,
        }
