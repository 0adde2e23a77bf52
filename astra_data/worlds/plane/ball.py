"""A ball on a carpet: rolling, and contacts with bodies that kick it or walk into it. Batched torch."""

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.worlds.plane.geometry import turned

ROLLING_M_S2 = 0.30
"""Deceleration of the ball of RoboCup's Standard Platform League (B-Human's ballSpecification)."""
BALL_RADIUS_M = 0.05
"""Of the same ball."""
_KICKS_ABOVE = 0.5
"""A third entry of a command above this asks for a kick."""


def asks_to_kick(command: Tensor) -> Tensor:
    """Return which commands (B, 3), a planar velocity and a kick entry, ask for a kick: (B, 1) bool.

    Raises:
        BadInputError: the commands have no kick entry, as in datasets from before there was one.
    """
    if command.shape[-1] != 3:
        raise BadInputError(
            f"expected commands of 3 values, a planar velocity and whether to kick, got {command.shape[-1]}: "
            "collect the episodes and train the policies of this task anew"
        )
    return command[:, 2:] > _KICKS_ABOVE


def roll(
    position: Tensor, velocity: Tensor, period_s: Tensor | float, deceleration_m_s2: Tensor | float
) -> tuple[Tensor, Tensor]:
    """Roll balls for `period_s`, slowed by an even friction until they lie.

    Args:
        position: of the balls, (B, 2) in m.
        velocity: of the balls, (B, 2) in m/s.
        period_s: duration, (B, 1) or one for all.
        deceleration_m_s2: of a rolling ball, (B, 1) or one for all.

    Returns:
        positions and velocities (B, 2) of the balls.
    """
    speed = velocity.norm(dim=-1, keepdim=True)
    slower = (speed - deceleration_m_s2 * period_s).clamp_min(0.0)
    rolling_s = (speed - slower) / deceleration_m_s2
    direction = velocity / speed.clamp_min(1e-9)
    way = 0.5 * (speed + slower) * rolling_s
    return position + direction * way, direction * slower


def knock(
    before: Tensor,
    after: Tensor,
    ball: Tensor,
    velocity: Tensor,
    *,
    reach_m: float,
    speed_m_s: Tensor | float,
    turn_rad: Tensor | float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Move the balls that bodies walk into.

    Args:
        before: positions of the bodies before the step, (B, 2) in m.
        after: after it, (B, 2) in m.
        ball: positions of the balls, (B, 2) in m.
        velocity: of the balls, (B, 2) in m/s.
        reach_m: distance between the centers below which a body touches a ball.
        speed_m_s: of a touched ball, along the line between the centers, (B, 1) or one for all.
        turn_rad: angle between that line and the ball's direction, (B,) or one for all.

    Returns:
        positions and velocities (B, 2) of the balls.
    """
    direction, distance = _seen_from(after, ball)
    approaches = ((after - before) * direction).sum(-1, keepdim=True) > 0
    touched = (distance < reach_m) & approaches
    leaving = turned(direction, torch.as_tensor(turn_rad, device=ball.device))
    return (
        torch.where(touched, after + direction * reach_m, ball),
        torch.where(touched, leaving * speed_m_s, velocity),
    )


def kick_away(
    body: Tensor,
    ball: Tensor,
    velocity: Tensor,
    asked: Tensor,
    *,
    reach_m: float,
    speed_m_s: Tensor | float,
    turn_rad: Tensor | float = 0.0,
) -> Tensor:
    """Kick balls within reach.

    Args:
        body: positions of the bodies, (B, 2) in m.
        ball: of the balls, (B, 2) in m.
        velocity: of the balls, (B, 2) in m/s.
        asked: which bodies are to kick, (B, 1) bool.
        reach_m: distance between the centers below which a body can kick a ball.
        speed_m_s: of a kicked ball, along the line between the centers, (B, 1) or one for all.
        turn_rad: angle between that line and the ball's direction, (B,) or one for all.

    Returns:
        velocities (B, 2) of the balls.
    """
    direction, distance = _seen_from(body, ball)
    leaving = turned(direction, torch.as_tensor(turn_rad, device=ball.device))
    return torch.where(asked & (distance < reach_m), leaving * speed_m_s, velocity)


def _seen_from(body: Tensor, ball: Tensor) -> tuple[Tensor, Tensor]:
    """Return the direction (B, 2) and distance (B, 1) of balls from bodies, both (B, 2)."""
    apart = ball - body
    distance = apart.norm(dim=-1, keepdim=True)
    return apart / distance.clamp_min(1e-9), distance
