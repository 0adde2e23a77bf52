"""Kicking: a rolling ball, the point mass with a ball that simulates it, and the objective; the reward is ours."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.lazy import Tensor, torch
from astra_data.worlds.geometry import turned
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.plane.navigation import PlanarObjective, PlanarStates

ROLLING_M_S2 = 0.30  # deceleration of the ball of RoboCup's Standard Platform League (B-Human's ballSpecification)
BALL_RADIUS_M = 0.05  # of the same ball
_KICKS_ABOVE = 0.5  # a third entry of a command above this asks for a kick
_LIES_M_S = 0.15  # a slower ball lies: it would roll for 4 cm at most, and estimates of its speed are never quite zero
_LEAVES_M_S = 0.5  # least speed with which corrections set a ball rolling that lay, as the NAO's kicks did
_SEEN_M_S = 0.2  # speed at which balls that were hit are first measured: they began to roll within the step
_TURN_RAD = 0.4  # deviation of the ways in which hit balls leave from the simulator's, as in recorded kicks of the NAO
_FADES = 0.9  # share of the evidence of a hit that counts in the next step: who kicks on seldom hits later
_NEAR_M = (0.18, 0.5)  # distances from the ball at which recorded episodes begin; a foot reaches as far as the first


def asks_to_kick(command: Tensor) -> Tensor:
    """Return which commands (B, 3), a planar velocity and a kick entry, ask for a kick: (B, 1) bool."""
    return command[:, 2:] > _KICKS_ABOVE


def roll(
    position: Tensor, velocity: Tensor, period_s: Tensor | float, deceleration_m_s2: Tensor | float
) -> tuple[Tensor, Tensor]:
    """Roll balls (B, 2), slowed by an even friction until they lie; return positions and velocities (B, 2)."""
    speed = velocity.norm(dim=-1, keepdim=True)
    slower = (speed - deceleration_m_s2 * period_s).clamp_min(0.0)
    rolling_s = (speed - slower) / deceleration_m_s2
    direction = velocity / speed.clamp_min(1e-9)
    way = 0.5 * (speed + slower) * rolling_s
    return position + direction * way, direction * slower


class Contact(NamedTuple):
    """How bodies or their kicks move balls within reach: along the line between the centers, turned."""

    reach_m: float
    speed_m_s: Tensor | float  # (B, 1) or one for all
    turn_rad: Tensor | float = 0.0  # (B,) or one for all

    def of(self, body: Tensor, ball: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the direction (B, 2) of balls from bodies, which are in reach (B, 1), and how they leave (B, 2)."""
        apart = ball - body
        distance = apart.norm(dim=-1, keepdim=True)
        direction = apart / distance.clamp_min(1e-9)
        leaving = turned(direction, torch.as_tensor(self.turn_rad, device=ball.device))
        return direction, distance < self.reach_m, leaving * self.speed_m_s


def knock(before: Tensor, after: Tensor, ball: Tensor, velocity: Tensor, contact: Contact) -> tuple[Tensor, Tensor]:
    """Move the balls that bodies walk into, from `before` to `after`; return places and velocities, (B, 2)."""
    direction, within, leaving = contact.of(after, ball)
    touched = within & (((after - before) * direction).sum(-1, keepdim=True) > 0)
    return torch.where(touched, after + direction * contact.reach_m, ball), torch.where(touched, leaving, velocity)


class BallAgent(PlanarStates):
    """B point masses, each with a ball: [x, y, vx, vy, ball x, ball y, ball vx, ball vy], in m and m/s.

    A command is the velocity of the next step and whether to stand and kick. Corrections move only balls that rolled
    or were touched. Whether one that lay starts to roll is drawn once: none creeps, and no policy waits for luck.
    """

    state_size = 8

    def __init__(
        self,
        maze: Maze,
        num_envs: int,
        *,
        reach_m: float,
        knock_m_s: float,
        kick_reach_m: float,
        kick_m_s: float,
        device: str = "cpu",
        **body: float,
    ) -> None:
        """Build B of them; `knock_m_s` and `kick_m_s` are speeds of balls within reach, `body` is of the mass."""
        super().__init__(maze, num_envs, device=device, **body)
        self.parameters |= {"reach_m": reach_m, "knock_m_s": knock_m_s}
        self.parameters |= {"kick_reach_m": kick_reach_m, "kick_m_s": kick_m_s}
        self._rolls = torch.zeros(num_envs, 1, dtype=torch.bool, device=device)
        self.memory = self._undecided(num_envs)
        self._deceleration_m_s2: Tensor | float = ROLLING_M_S2
        self._contact_turn_rad: Tensor | float = 0.0

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, X); given `rows` are drawn for anew."""
        super().reset_to(state, rows)
        if rows is not None:
            self.memory = self.memory.index_copy(0, rows, self._undecided(len(rows)))

    def _undecided(self, count: int) -> Tensor:
        """Return the memory (n, 2) of so many balls of which there is no evidence."""
        device = self.state.device
        return torch.cat([torch.rand(count, 1, device=device), torch.zeros(count, 1, device=device)], dim=-1)

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use the parameters of a `BallVariation` by name, (B, 1) each, from the next step on."""
        super().vary(parameters)
        self._deceleration_m_s2 = ROLLING_M_S2 * parameters["ball_friction"]
        self._contact_turn_rad = torch.deg2rad(parameters["contact_direction_deg"][:, 0])

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 3), clipped to ±1 per axis; return the new state (B, 8)."""
        of, turn, kicks = self.parameters, self._contact_turn_rad, asks_to_kick(action)
        position, _, ball, velocity = self.state.split(2, dim=-1)
        way = ~kicks * self.commanded_velocity(action[:, :2]) * self.period_s
        moved, self.blocked = self.free.slide(position, position + way)
        ball, velocity = knock(position, moved, ball, velocity, Contact(of["reach_m"], of["knock_m_s"], turn))
        _, within, leaving = Contact(of["kick_reach_m"], of["kick_m_s"], turn).of(moved, ball)
        velocity = torch.where(kicks & within, leaving, velocity)
        self._rolls = velocity.norm(dim=-1, keepdim=True) > _LIES_M_S
        ball, velocity = roll(ball, velocity, self.period_s, self._deceleration_m_s2)
        self.state = torch.cat([moved, (moved - position) / self.period_s, ball, velocity], dim=-1)
        return self.state

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Slide masses to `landed` (B, 8); move the balls, or draw whether they move: see the class."""
        own = self.state[:, 6:]
        moved = super().settle(before, landed)
        ball, velocity = before[:, 4:6], before[:, 6:]
        speed = moved[:, 6:].norm(dim=-1, keepdim=True)
        lay = velocity.norm(dim=-1, keepdim=True) <= _LIES_M_S
        turn_rad = _TURN_RAD * torch.randn(len(ball), device=ball.device)
        direction = torch.nn.functional.normalize(torch.where(lay, turned(own, turn_rad), velocity))
        slowed_m_s = self._deceleration_m_s2 * self.period_s
        leaving = (speed + slowed_m_s).clamp_min(_LEAVES_M_S * lay)
        rolled = torch.cat(roll(ball, direction * leaving, self.period_s, self._deceleration_m_s2), dim=-1)
        touched = self._rolls & lay
        needed, evidence = self.memory.split(1, dim=-1)
        evidence = _FADES * evidence + touched * speed / _SEEN_M_S
        rolls = torch.where(lay, touched & (evidence > needed), self._rolls & (speed > _LIES_M_S))
        undecided = self._undecided(len(ball))
        self.memory = torch.where(rolls, undecided, torch.cat([needed, evidence], dim=-1))
        still = torch.cat([ball, torch.zeros_like(ball)], dim=-1)
        self.reset_to(torch.cat([moved[:, :4], torch.where(rolls, rolled, still)], dim=-1))
        return self.state


@dataclass(frozen=True)
class Kicking(PlanarObjective):
    """Get the ball into the goal at the right end of `maze`, an empty field; goals (..., 2): the goal line's middle."""

    action_size = 3

    goal_line_m: float = 1.5  # its x
    goal_half_width_m: float = 0.75
    side_line_m: float = 2.0  # |y| of both
    back_line_m: float = -2.0
    ball_x_m: tuple[float, float] = (-0.5, 0.0)  # at the start
    ball_y_m: tuple[float, float] = (-0.6, 0.6)
    distance_m: tuple[float, float] = (0.4, 1.0)  # of the robot from the ball at the start
    behind_m: float = 0.2  # distance from the ball of the point behind it that the shaping reward leads to

    def draw_starts(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw states (count, 8) at rest: the ball in front of the goal, the robot around it."""
        ball = np.stack([rng.uniform(*self.ball_x_m, count), rng.uniform(*self.ball_y_m, count)], axis=1)
        angle, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(*self.distance_m, count)
        robot = ball + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        rest = np.zeros_like(robot)
        return np.concatenate([robot, rest, ball, rest], axis=1)

    def draw_anywhere(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw states (count, 8) at rest with the robot near its ball, which it rarely meets from afar."""
        return replace(self, distance_m=_NEAR_M).draw_starts(rng, count)

    def draw_goals(self, rng: np.random.Generator, count: int) -> Floats:
        """Return the middle of the goal line, (count, 2)."""
        return np.tile([self.goal_line_m, 0.0], (count, 1))

    def observe(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return positions, velocities, and vectors to the ball, the goal and behind the ball, (..., 14)."""
        robot, velocity, ball, rolling = state.split(2, dim=-1)
        behind = self._behind(ball, goal) - robot
        places = [robot / 2, ball / 2, (goal - ball) / 2]
        return torch.cat([*places, 4 * velocity, rolling, 4 * (ball - robot), 4 * behind], dim=-1)

    def _behind(self, ball: Tensor, goal: Tensor) -> Tensor:
        to_goal = goal - ball
        back: Tensor = self.behind_m * to_goal / to_goal.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        return ball - back

    def places(self, state: Tensor) -> Tensor:
        """Return the positions of robot and ball in states (..., 8), (..., 4)."""
        return state[..., [0, 1, 4, 5]]

    def reached(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return which balls (B,) of states (B, 8) are in the goal."""
        ball = state[:, 4:6]
        return (ball[:, 0] >= self.goal_line_m) & (ball[:, 1].abs() <= self.goal_half_width_m)

    def missed(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return which balls (B,) of states (B, 8) left the field beside the goal."""
        x, y = state[:, 4:6].unbind(-1)
        out = (x >= self.goal_line_m) | (x < self.back_line_m) | (y.abs() > self.side_line_m)
        return out & ~self.reached(state, goal)

    def reward(self, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
        """Return the reward (B,) of a step between states (B, 8), a failure where `failed` (B,)."""
        gained = self._potential(after, goal) - self._potential(before, goal)
        return gained + self.success_reward * self.reached(after, goal) + self.failure_reward * failed

    def _potential(self, state: Tensor, goal: Tensor) -> Tensor:
        robot, _, ball, _ = state[:, :8].split(2, dim=-1)
        ball_left: Tensor = (goal - ball).norm(dim=-1)
        robot_left: Tensor = (self._behind(ball, goal) - robot).norm(dim=-1)
        return -ball_left - 0.5 * robot_left
