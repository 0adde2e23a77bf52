"""A ball on a carpet: how it rolls, and how planar bodies kick it and walk into it. Batched torch."""

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.worlds.plane.geometry import turned

ROLLING_M_S2 = 0.30
"""Deceleration of the ball of RoboCup's Standard Platform League (B-Human's ballSpecification)."""
BALL_RADIUS_M = 0.05
"""Likewise."""
_KICKS_ABOVE = 0.5
"""Third entry of the commands of robots that have a ball."""


def asks_to_kick(command: Tensor) -> Tensor:
    """Tell which commands (B, 3), planar velocity and a wish, ask for a kick: (B, 1) bool.

    Raises:
        BadInputError: the commands say nothing of kicks, as before there was such a wish.
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
        position: where the balls are, (B, 2) in m.
        velocity: of the balls, (B, 2) in m/s.
        period_s: how long, (B, 1) or one for all.
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
    """Knock away the balls that bodies walk into.

    Args:
        before: where the bodies were, (B, 2).
        after: where they are, (B, 2).
        ball: where the balls are, (B, 2).
        velocity: of the balls, (B, 2).
        reach_m: between the centres of a body and a ball that it touches.
        speed_m_s: at which a ball leaves along the line between the centres, (B, 1) or one for all.
        turn_rad: the ball leaves turned by this, (B,) or one for all.

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
    """Kick the balls that bodies are `asked` (B, 1) to and can reach.

    Args:
        body: where the bodies are, (B, 2).
        ball: where the balls are, (B, 2).
        velocity: of the balls, (B, 2).
        asked: which are to kick, (B, 1) bool.
        reach_m: between the centres of a body and a ball that it can kick.
        speed_m_s: at which a ball leaves along the line between the centres, (B, 1) or one for all.
        turn_rad: the ball leaves turned by this, (B,) or one for all.

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
