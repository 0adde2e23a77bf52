"""The NAO's tasks, on simulated stand-ins: navigation in an S-shaped maze, and kicking (Section V-C)."""

import json
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.core.lazy import Tensor, torch
from astra_data.dataset.columns import ABSTRACT_STATE, ACTION, GOAL, STATE
from astra_data.robots.nao.kicking import BallAgent, Kicking, asks_to_kick
from astra_data.robots.nao.robot import CONTROL_STEP_S, BatchedNao
from astra_data.robots.nao.walk import JOINTS, TICK_S
from astra_data.worlds.geometry import wrapped
from astra_data.worlds.plane.mazes import FIELD, S_MAZE
from astra_data.worlds.plane.navigation import Navigation, PlanarObjective, PlanarTarget, PointMass, VariedPlanar
from astra_data.worlds.protocols import Step, rows_in
from astra_data.worlds.task import PLANAR_GOAL, PLANAR_STATE, ColumnEntry, Task, Varied, column, entries
from astra_data.worlds.variation import RANDOMIZED_ACTIONS, WIDE_RANGES, BallVariation


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
        self._spread = np.array([errors.drift_m, errors.drift_m, errors.drift_rad])
        self.pose: Floats = np.zeros((num_robots, 3))
        self._drift: Floats = np.zeros((num_robots, 3))
        self._true: Floats = np.zeros((num_robots, 3))

    def reset(self, rows: NDArray[np.intp], pose: Floats, rng: np.random.Generator) -> None:
        """Restart `rows` (n,) at the true `pose` (n, 3), with an error of the usual size."""
        self._drift[rows] = self._spread * rng.normal(size=(len(rows), 3))
        self._true[rows] = pose
        self.pose[rows] = pose + self._drift[rows]

    def update(self, pose: Floats, rng: np.random.Generator, active: Bools) -> None:
        """Update the estimates of the robots in `active` (B,) after a step to the true `pose` (B, 3)."""
        errors, count = self.errors, len(pose)
        keep = np.exp(-self.step_s / errors.drift_s)
        drift = keep * self._drift + np.sqrt(1 - keep**2) * self._spread * rng.normal(size=(count, 3))
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
        seen = {"seen_ball": self.position, "seen_ball_velocity": self.velocity}
        return seen | {"seen_ball_since": self.unseen_s, "seen_ball_error": self._error}


_PLANAR = [0, 1, 4, 5]
STATE_SIZE = 29
"""Estimated x, y, cos and sin of the heading, planned velocity x, y in the world, angles (11) of the legs'
joints, gyroscope (3), tilt (2), load (2) of the feet, phase (2) of the step, planned velocity (3) in the
body. The estimate of the ball follows, if there is one."""
_BALL = [STATE_SIZE + entry for entry in range(4)]


def nao_to_point_mass[Array: (NDArray[np.float32], Floats, Tensor)](state: Array) -> Array:
    """Keep a NAO's estimated position in m and planned velocity in m/s: (..., S) to [x, y, vx, vy] (..., 4)."""
    return state[..., _PLANAR]


def nao_to_ball_agent[Array: (NDArray[np.float32], Floats, Tensor)](state: Array) -> Array:
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
        errors: PerceptionErrors = PerceptionErrors(),
        num_threads: int | None = None,
    ) -> None:
        super().__init__(objective, num_envs, start_anywhere=start_anywhere)
        self.has_ball, self.action_size = ball, objective.action_size
        self.robots = BatchedNao(num_envs, seed=seed, maze=objective.maze, ball=ball, num_threads=num_threads)
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

    def _body_command(self, velocity: Tensor, kick: Bools | None) -> Floats:
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
        tensors = {name: torch.from_numpy(values.copy()) for name, values in self._arrays().items()}
        drawn = json.dumps(self._rng.bit_generator.state).encode()
        return tensors | {"goal": self.goal.clone(), "drawn": torch.tensor(list(drawn), dtype=torch.uint8)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        for name, values in self._arrays().items():
            values[:] = state[name].numpy()
        self.goal = state["goal"].clone()
        self._rng.bit_generator.state = json.loads(bytes(state["drawn"].tolist()))

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return self.robots.arrays() | self.localisation.arrays() | self.sight.arrays()


_RADIUS_M = 0.1  # radius of the mass at walls in the simulators: as in AntMaze, and less than the robot's 0.14 m
_BODY: dict[str, Any] = {"timestep_s": CONTROL_STEP_S, "radius_m": _RADIUS_M, "speed_m_s": SPEED_M_S}
_CONTACT: dict[str, Any] = {"kick_reach_m": 0.35, "kick_m_s": 1.0, "reach_m": 0.22, "knock_m_s": 0.7}
"""Of the robot with its ball. The reach of a kick is that of the paper's group's published simulator of an attacking
NAO (AbstractSim 2023); a foot really reaches 0.22 m far. Walking bodies touch the ball with feet and shins, at a median
of 0.22 m between the centers in episodes of random commands; it leaves at a median of 0.7 m/s."""

KICK_RANGES = BallVariation(
    **WIDE_RANGES.model_dump(),
    ball_friction=(0.8, 1.2),
    ball_position_noise_m=(0.03, 0.03),
    ball_velocity_noise_m_s=(0.0, 0.02),
    contact_direction_deg=(-5.0, 5.0),
)
"""Of COMPASS in kicking: the paper names the ball's friction, position, velocity and direction after contact
without printing ranges for them; these are the robot's."""

_QUANTITIES = {"position_m": (0, 1), "velocity_m_s": (2, 3)}
_BALL_QUANTITIES = {"ball_position_m": (4, 5), "ball_velocity_m_s": (6, 7)}


_STATE = [
    *entries("x y", "m", "world", "position"),
    *entries("cos_heading sin_heading", "1", "world", "vector"),
    *entries("vx vy", "m/s", "world", "vector"),
    *entries(" ".join(JOINTS), "rad", "joint", "invariant"),
    *entries("gyro_x gyro_y gyro_z", "rad/s", "body", "invariant"),
    *entries("roll pitch", "rad", "body", "invariant"),
    *entries("load_left load_right", "50 N", "body", "invariant"),
    *entries("step_sine step_cosine", "1", "body", "invariant"),
    *entries("planned_forward planned_left", "m/s", "body", "invariant"),
    ColumnEntry("planned_turn", "rad/s", "body", "invariant"),
]
_ROLLING = [*entries("ball_x ball_y", "m", "world", "position"), *entries("ball_vx ball_vy", "m/s", "world", "vector")]
_UNSEEN = ColumnEntry("ball_unseen", "s", "body", "invariant")
_COMMAND = [*entries("command_vx command_vy", "0.25 m/s", "world", "vector")]
_KICK = ColumnEntry("kick", "1", "body", "invariant")


def _task(*, ball: bool, **own: Any) -> Task:
    meaning = "what the robot believes of itself" + (" and of the ball" if ball else "")
    wish = ", and above 0.5 to stand and kick" if ball else ""
    rolling = _ROLLING if ball else []
    state, command = [*_STATE, *rolling, *[_UNSEEN] * ball], [*_COMMAND, *[_KICK] * ball]
    abstract = [*PLANAR_STATE, *rolling]
    return Task(
        make_target=partial(NaoEnv, ball=ball),
        beyond=nao_beyond,
        state=column(STATE, state, meaning),
        goal=column(GOAL, PLANAR_GOAL, "the middle of the goal line" if ball else "where to go"),
        action=column(ACTION, command, f"commanded planar velocity, ±1 per axis{wish}"),
        abstract_state=column(ABSTRACT_STATE, abstract, "abstract state of the target before the action"),
        commands=dict.fromkeys(("vx", "vy", *["kick"] * ball), (-1.0, 1.0)),
        quantities=_QUANTITIES | (_BALL_QUANTITIES if ball else {}),
        timestep_s=CONTROL_STEP_S,
        facts={"stand_in": "mujoco", "tick_s": TICK_S},
        wall_reach_m=0.3,
        **own,
    )


NAVIGATION = _task(
    name="nao-navigation",
    ball=False,
    instruction="walk through the maze to the goal",
    objective=Navigation(
        S_MAZE,
        horizon=500,
        success_radius_m=0.3,
        spread_m=0.05,
        start_clearance_m=0.3,
        start_offsets_m=((0.0, 0.0), (0.5, 0.0), (1.0, 0.0)),
        meter_reward=4.0,  # a touch costs a meter; if it cost a third of the path, policies would learn to stand
        failure_reward=-4.0,
        path_clearance_m=0.25,
        position_waves=3,  # without a memory, policies whose position is not in the latent need these to learn it
        ends_at_walls=True,
    ),
    make_simulator=partial(PointMass, S_MAZE, **_BODY),
    varied=Varied(VariedPlanar, RANDOMIZED_ACTIONS, WIDE_RANGES),
    abstraction=nao_to_point_mass,
    simulator_id="point_mass",
)
KICK = _task(
    name="nao-kick",
    ball=True,
    instruction="kick the ball into the goal",
    objective=Kicking(FIELD, horizon=156),
    make_simulator=partial(BallAgent, FIELD, **_BODY, **_CONTACT),
    varied=Varied(VariedPlanar, RANDOMIZED_ACTIONS, KICK_RANGES),
    abstraction=nao_to_ball_agent,
    simulator_id="ball_agent",
)
