"""The NAO's tasks, on simulated stand-ins: navigation in an S-shaped maze, and kicking (Section V-C)."""

from functools import partial
from typing import Any

from astra_data.dataset.columns import ABSTRACT_STATE, ACTION, GOAL, STATE
from astra_data.robots.nao.kicking import BallAgent, Kicking
from astra_data.robots.nao.robot import CONTROL_STEP_S
from astra_data.robots.nao.target import SPEED_M_S, NaoEnv, nao_beyond, nao_to_ball_agent, nao_to_point_mass
from astra_data.robots.nao.walk import JOINTS, TICK_S
from astra_data.worlds.plane.mazes import FIELD, S_MAZE
from astra_data.worlds.plane.navigation import Navigation
from astra_data.worlds.plane.point_mass import PointMass, VariedPlanar
from astra_data.worlds.task import PLANAR_GOAL, PLANAR_STATE, ColumnEntry, Plane, Task, Varied, column, entries
from astra_data.worlds.variation import RANDOMIZED_ACTIONS, WIDE_RANGES, BallVariation

_RADIUS_M = 0.1  # radius of the mass at walls in the simulators: as in AntMaze, and less than the robot's 0.14 m
_BODY: dict[str, Any] = {"timestep_s": CONTROL_STEP_S, "radius_m": _RADIUS_M, "speed_m_s": SPEED_M_S}
_CONTACT: dict[str, Any] = {"kick_reach_m": 0.35, "kick_m_s": 1.0, "reach_m": 0.22, "knock_m_s": 0.7}
"""Of the robot with its ball. The reach of a kick is that of the paper's group's published simulator of an
attacking NAO (AbstractSim 2023); a foot really reaches 0.22 m far. Walking bodies touch the ball with feet
and shins, at a median of 0.22 m between the centers in episodes of random commands; it leaves at a median of
0.7 m/s."""

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
_BALL = [*entries("ball_x ball_y", "m", "world", "position"), *entries("ball_vx ball_vy", "m/s", "world", "vector")]
_UNSEEN = ColumnEntry("ball_unseen", "s", "body", "invariant")
_COMMAND = [*entries("command_vx command_vy", "0.25 m/s", "world", "vector")]
_KICK = ColumnEntry("kick", "1", "body", "invariant")


def _task(*, ball: bool, **own: Any) -> Task:
    meaning = "what the robot believes of itself" + (" and of the ball" if ball else "")
    wish = ", and above 0.5 to stand and kick" if ball else ""
    rolling = _BALL if ball else []
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
        plane=Plane(wall_reach_m=0.3),
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
        # A touch costs as much as a meter; if it cost a third of the path, policies would learn to stand.
        meter_reward=4.0,
        failure_reward=-4.0,
        path_clearance_m=0.25,
        # Policies without a memory, whose position is not in the latent, do not learn it without these.
        position_waves=3,
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
