"""NAOs, simulated stand-ins, that follow planar velocity commands in a maze or with a ball; their φ."""

import json

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.robots.nao.kicking import asks_to_kick
from astra_data.robots.nao.perception import BallSight, Localisation, PerceptionErrors
from astra_data.robots.nao.robot import CONTROL_STEP_S, BatchedNao
from astra_data.worlds.geometry import wrapped
from astra_data.worlds.plane.navigation import PlanarObjective, PlanarTarget
from astra_data.worlds.protocols import Step, rows_in

_PLANAR = [0, 1, 4, 5]
STATE_SIZE = 29
"""Estimated x, y, cos and sin of the heading, planned velocity x, y in the world, angles (11) of the legs'
joints, gyroscope (3), tilt (2), load (2) of the feet, phase (2) of the step, planned velocity (3) in the
body. The estimate of the ball follows, if there is one."""
_BALL = [STATE_SIZE + entry for entry in range(4)]


def nao_to_point_mass[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep a NAO's estimated position in m and planned velocity in m/s: (..., S) to [x, y, vx, vy] (..., 4)."""
    return state[..., _PLANAR]


def nao_to_ball_agent[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep what `nao_to_point_mass` does, and the ball's estimated position and velocity: (..., 34) to (..., 8)."""
    return state[..., _PLANAR + _BALL]


def nao_beyond(state: Tensor) -> Tensor:
    """Return the part of a NAO's state that φ drops: (..., 29) to (..., 25), with a ball 34 to 26."""
    rest = [entry for entry in range(state.shape[-1]) if entry not in _PLANAR + _BALL]
    return state[..., rest]


SPEED_M_S = 0.25  # of a command of 1, along each axis: the largest forward speed of B-Human's walk
TURN_GAIN_PER_S = 2.0  # turning rate per rad between heading and direction of motion
TURN_LIMIT_RAD_S = 1.0
SEARCH_AFTER_S = 1.5  # a robot that has not seen its ball for longer turns to search for it
_STANDING = 0.05  # robots do not turn at shorter commands
_FOOT_LOAD_N = 50.0  # scale of the pressures on the soles
BALL_SIZE = 5  # with a ball there follow its estimated position (2) and velocity (2), and the time since it was seen


class NaoEnv(PlanarTarget):
    """B NAOs that act on estimates, their states; rewards are of true positions, steps last 0.192 s.

    Action: world-frame velocity command, ±1 per axis; above 0.5 a third entry asks for a kick. They turn by themselves.
    """

    def __init__(
        self,
        objective: PlanarObjective,
        num_envs: int,
        *,
        seed: int,
        ball: bool = False,
        start_anywhere: bool = False,
        errors: PerceptionErrors | None = None,
        num_threads: int | None = None,
    ) -> None:
        super().__init__(objective, num_envs, start_anywhere=start_anywhere)
        self.has_ball, self.action_size = ball, objective.action_size
        self.robots = BatchedNao(num_envs, seed=seed, maze=objective.maze, ball=ball, num_threads=num_threads)
        errors = errors or PerceptionErrors()
        self.localisation = Localisation(num_envs, errors, CONTROL_STEP_S)
        self.sight = BallSight(num_envs, errors, CONTROL_STEP_S)
        self.observation_size = STATE_SIZE + BALL_SIZE * ball + 2
        self.reseed(seed)

    @property
    def state(self) -> Tensor:
        """Estimates and sensor readings of the robots, (B, S) float32."""
        pose, robots, gait = self.localisation.pose, self.robots, self.robots.gait
        cos, sin, planned = np.cos(pose[:, 2:]), np.sin(pose[:, 2:]), gait.velocity()
        forward, left, _ = np.split(planned, 3, axis=1)
        swing = np.where(gait.left_swings, 1.0, -1.0)[:, None]
        angle = np.pi * gait.phase[:, None]
        load = robots.bodies.pressure.reshape(-1, 2, 4).sum(-1) / _FOOT_LOAD_N
        parts = [
            *(pose[:, :2], cos, sin, cos * forward - sin * left, sin * forward + cos * left),
            *(robots.angles, robots.bodies.gyro, robots.tilt, load),
            *(swing * np.sin(angle), swing * np.cos(angle), planned),
        ]
        if self.has_ball:
            sight = self.sight
            parts += [sight.position, sight.velocity, sight.unseen_s[:, None]]
        return torch.from_numpy(np.concatenate(parts, axis=1)).float()

    @property
    def truth(self) -> Tensor:
        """The true abstract states, (B, X) float32."""
        robots = self.robots
        parts = [robots.pose[:, :2], robots.velocity[:, :2]]
        if self.has_ball:
            parts += [robots.ball, robots.ball_velocity]
        return torch.from_numpy(np.concatenate(parts, axis=1)).float()

    @property
    def position(self) -> Tensor:
        """True positions of robots, then of their balls where there are any, (B, 2) or (B, 4) float32, m."""
        return self.objective.places(self.truth)

    @property
    def wall_contact(self) -> Tensor:
        """Which robots touched a wall in their last step, (B,) bool."""
        return torch.from_numpy(self.robots.bodies.touching.copy())

    def reseed(self, seed: int) -> None:
        """Restart the random numbers of starts, goals, headings, traits, errors and sensors at `seed`."""
        super().reseed(seed)
        self.robots.reseed(seed)

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Set the robots in `mask` (B,), by default all, to new starts with random headings."""
        rows = rows_in(mask, self.num_envs)
        start = self._start(rows)
        self._aim(rows)
        yaw = self._rng.uniform(-np.pi, np.pi, len(rows))
        self._stand(rows, np.column_stack([start[:, :2], yaw]), start[:, 4:6] if self.has_ball else None)
        return self._observe()

    def reset_to(self, rows: NDArray[np.intp], state: Floats) -> None:
        """Set the robots `rows` (n,) and their balls to the estimated positions in `state` (n, S)."""
        yaw = np.arctan2(state[:, 3], state[:, 2])
        ball = state[:, STATE_SIZE : STATE_SIZE + 2] if self.has_ball else None
        self._stand(rows, np.column_stack([state[:, :2], yaw]), ball)

    def _stand(self, rows: NDArray[np.intp], pose: Floats, ball: Floats | None) -> None:
        self.robots.reset(rows, pose, self._rng, ball)
        self.localisation.reset(rows, pose, self._rng)
        if ball is not None:
            self.sight.reset(rows, ball)
        self.failed[rows] = False

    def step(self, action: Tensor, active: Tensor | None = None) -> Step:
        """Follow the commands `action` (B, A) for 0.192 s; rows outside `active` (B,) stay."""
        moving = np.ones(self.num_envs, dtype=bool) if active is None else active.numpy()
        before = self.truth
        kick = asks_to_kick(action).squeeze(-1).numpy() if self.has_ball else None
        self.robots.step(self._body_command(action[:, :2], kick), moving, kick)
        self.localisation.update(self.robots.pose, self._rng, moving)
        if self.has_ball:
            estimated = self.localisation.pose
            self.sight.update(self.robots.ball, self.robots.pose, estimated, self._rng, moving)
        return self._judged(before, self.truth, self.robots.bodies.fallen)

    def _body_command(self, velocity: Tensor, kick: NDArray[np.bool_] | None) -> Floats:
        """Turn world-frame commands (B, 2) into forward, left and turning speed (B, 3): see `NaoEnv`."""
        command = velocity.clamp(-1.0, 1.0).double().numpy()
        x, y = (SPEED_M_S * command).T
        heading = self.localisation.pose[:, 2]
        cos, sin = np.cos(heading), np.sin(heading)
        ahead = np.arctan2(y, x)
        if kick is not None:
            apart = self.sight.position - self.localisation.pose[:, :2]
            ahead = np.arctan2(apart[:, 1], apart[:, 0])
        astray = wrapped(ahead - heading)
        turn = (TURN_GAIN_PER_S * astray).clip(-TURN_LIMIT_RAD_S, TURN_LIMIT_RAD_S)
        called = np.linalg.norm(command, axis=1) > _STANDING
        turn *= called if kick is None else called | kick
        if kick is not None:
            turn = np.where(self.sight.unseen_s > SEARCH_AFTER_S, TURN_LIMIT_RAD_S, turn)
            facing = ~kick * np.cos(astray).clip(0.0) ** 2
            x, y = facing * x, facing * y
        return np.stack([cos * x + sin * y, cos * y - sin * x, turn], axis=1)

    def state_dict(self) -> dict[str, Tensor]:
        """Return what `load_state_dict` needs to continue from here."""
        arrays = {**self.robots.state_dict(), **self.localisation.arrays(), **self.sight.arrays()}
        tensors = {name: torch.from_numpy(np.array(value)) for name, value in arrays.items()}
        drawn = json.dumps(self._rng.bit_generator.state).encode()
        return tensors | {"goal": self.goal.clone(), "drawn": torch.tensor(list(drawn), dtype=torch.uint8)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        self.robots.load_state_dict({name: values.numpy() for name, values in state.items()})
        for name, values in (self.localisation.arrays() | self.sight.arrays()).items():
            values[:] = state[name].numpy()
        self.goal = state["goal"].clone()
        self._rng.bit_generator.state = json.loads(bytes(state["drawn"].tolist()))
