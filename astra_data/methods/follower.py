"""Careful hand-written controllers, which show how well a task can be done (the ceiling)."""

import numpy as np

from astra_data.core.lazy import Tensor, torch
from astra_data.methods.method import Method
from astra_data.policies.episodes import Act
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.task import Task

FOLLOWER = Method("follower", "Careful follower", "#9A9A9A", role="ceiling", learn=None, planar=True)


def careful(task: Task, goal: Tensor) -> Act:
    """Return how to act on abstract states (B, X) for goals (B, G), in episodes that begin with `goal`."""
    return kicker if task.ball_index is not None else follower(task.maze, goal)


_MARGIN = 0.4  # distance from the walls that paths keep where they can, in cells of the maze
_SPEED = 0.85  # of the faster axis, in units of commands


def follower(maze: Maze, goals: Tensor) -> Act:
    """Return how to descend the distance to `goals` (B, 2), along paths away from the walls, below full speed."""
    costs_to = [maze.distance_field(goal, margin=_MARGIN * maze.scale) for goal in goals.numpy()]
    fields = torch.from_numpy(np.stack(costs_to)).float()
    half, angles = torch.tensor(maze.half_extent, dtype=torch.float32), torch.arange(32) * (2 * torch.pi / 32)
    directions = torch.stack([angles.cos(), angles.sin()], dim=-1)

    def act(state: Tensor, goal: Tensor) -> Tensor:
        position = state[:, :2]
        cells = ((position[:, None] + 0.2 * maze.scale * directions + half) / maze.fine_m).long()
        rows, columns = cells[..., 1].clamp(0, fields.shape[1] - 1), cells[..., 0].clamp(0, fields.shape[2] - 1)
        costs = fields[torch.arange(len(position))[:, None], rows, columns]
        straight = goal - position
        near = straight.norm(dim=-1, keepdim=True) < 0.25 * maze.scale
        return _at_speed(torch.where(near, straight, directions[costs.argmin(dim=1)]))

    return act


_CLEAR_M, _KICK_M, _BRAKE_M = 0.3, 0.2, 0.05  # from the ball: where robots walk around it, kick it, and slow down for
_CONE_RAD, _ROLLS_M_S = np.pi / 7, 0.3


def kicker(state: Tensor, goal: Tensor) -> Tensor:
    """Return commands (B, 3) at states (B, 8): to the point behind the ball, around it if near, up to it, a kick."""
    robot, _, ball, rolling = state.split(2, dim=-1)
    rolls = rolling.norm(dim=-1, keepdim=True) > _ROLLS_M_S
    ball = ball + rolls * rolling  # its position in a second
    to_goal = torch.nn.functional.normalize(goal - ball, dim=-1)
    distance = (robot - ball).norm(dim=-1, keepdim=True).clamp_min(1e-6)
    outward = (robot - ball) / distance
    is_behind = -(outward * to_goal).sum(-1, keepdim=True) > np.cos(_CONE_RAD)
    kicks = is_behind & (distance < _KICK_M)
    left = torch.stack([-outward[:, 1], outward[:, 0]], dim=-1)  # along a circle about the ball, the shorter way
    shorter = -(left * to_goal).sum(-1, keepdim=True).sign()
    around = shorter * left + 2 * (1 - distance / _CLEAR_M) * outward
    behind = ball - _CLEAR_M * to_goal
    way = torch.where(distance < 1.5 * _CLEAR_M, around, behind - robot)
    slower = ((distance - _KICK_M) / _BRAKE_M).clamp(0.3, 1.0)
    velocity = torch.where(is_behind, slower * _at_speed(-outward), _at_speed(way))
    return torch.cat([velocity, kicks.float()], dim=-1)


def _at_speed(heading: Tensor) -> Tensor:
    return _SPEED * heading / heading.abs().amax(dim=-1, keepdim=True).clamp_min(1e-6)
