"""Careful hand-written controllers, which show how well a task can be done (the ceiling)."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from astra_data.methods.method import Method
from astra_data.policies.episodes import Act
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.task import Task

FOLLOWER = Method(name="follower", title="Careful follower", color="#9A9A9A", role="ceiling", learn=None, planar=True)


def careful(task: Task, goal: Tensor) -> Act:
    """Return how to act on abstract states (B, X) for goals (B, G), in episodes that begin with `goal`."""
    if task.ball_index is not None:
        return CarefulKicker().command
    follower = CarefulFollower(task.maze)
    fields = follower.fields(goal)
    return lambda state, goal: follower.command(state[:, :2], goal, fields)


@dataclass(frozen=True)
class CarefulFollower:
    """Descend the distance to the goal, along paths away from the walls, a little below full speed."""

    maze: Maze
    margin: float = 0.4
    """Distance from the walls that paths keep where they can, in cells of the maze."""
    speed: float = 0.85
    """Of the faster axis, in units of commands."""

    def fields(self, goals: Tensor) -> Tensor:
        """Return the cost of going from each fine cell to each of `goals` (B, 2), (B, height, width)."""
        margin_m = self.margin * self.maze.scale
        fields = [self.maze.distance_field(goal, margin=margin_m) for goal in goals.numpy()]
        return torch.from_numpy(np.stack(fields)).float()

    def command(self, position: Tensor, goal: Tensor, fields: Tensor) -> Tensor:
        """Return velocity commands (B, 2), at `position` (B, 2): the cheapest way in `fields`, or to `goal`."""
        angles = torch.arange(32) * (2 * torch.pi / 32)
        directions = torch.stack([angles.cos(), angles.sin()], dim=-1)
        ahead = position[:, None] + 0.2 * self.maze.scale * directions
        half = torch.tensor(self.maze.half_extent, dtype=torch.float32)
        cells = ((ahead + half) / self.maze.fine_m).long()
        rows = cells[..., 1].clamp(0, fields.shape[1] - 1)
        columns = cells[..., 0].clamp(0, fields.shape[2] - 1)
        costs = fields[torch.arange(len(position))[:, None], rows, columns]
        best = directions[costs.argmin(dim=1)]
        straight = goal - position
        near = straight.norm(dim=-1, keepdim=True) < 0.25 * self.maze.scale
        return _at_speed(torch.where(near, straight, best), self.speed)


@dataclass(frozen=True)
class CarefulKicker:
    """Walk to the point behind the ball, around the ball if near, then up to it, and kick."""

    clear_m: float = 0.3
    cone_rad: float = np.pi / 7
    kick_m: float = 0.2
    brake_m: float = 0.05
    rolls_m_s: float = 0.3
    speed: float = 0.85

    def command(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return commands (B, 3) at abstract states (B, 8) for goals (B, 2)."""
        robot, _, ball, rolling = state.split(2, dim=-1)
        rolls = rolling.norm(dim=-1, keepdim=True) > self.rolls_m_s
        ball = ball + rolls * rolling  # its position in a second
        to_goal = torch.nn.functional.normalize(goal - ball, dim=-1)
        distance = (robot - ball).norm(dim=-1, keepdim=True).clamp_min(1e-6)
        outward = (robot - ball) / distance
        is_behind = -(outward * to_goal).sum(-1, keepdim=True) > np.cos(self.cone_rad)
        kicks = is_behind & (distance < self.kick_m)
        # Along a circle about the ball, the shorter way.
        left = torch.stack([-outward[:, 1], outward[:, 0]], dim=-1)
        shorter = -(left * to_goal).sum(-1, keepdim=True).sign()
        around = shorter * left + 2 * (1 - distance / self.clear_m) * outward
        behind = ball - self.clear_m * to_goal
        way = torch.where(distance < 1.5 * self.clear_m, around, behind - robot)
        slower = ((distance - self.kick_m) / self.brake_m).clamp(0.3, 1.0)
        velocity = torch.where(is_behind, slower * _at_speed(-outward, self.speed), _at_speed(way, self.speed))
        return torch.cat([velocity, kicks.float()], dim=-1)


def _at_speed(heading: Tensor, speed: float) -> Tensor:
    return speed * heading / heading.abs().amax(dim=-1, keepdim=True).clamp_min(1e-6)
