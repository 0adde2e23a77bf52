"""A cart with a payload that tips: the task, and a kinematic unicycle as its abstract simulator."""

import numpy as np
import torch

from astra_data import Column, Objective, Task

TIMESTEP_S = 0.1


class Unicycle:
    """Carts [x, y, yaw] that do at once what they are told, and carry nothing."""

    abstract_state = Column(
        "abstract.state", size=3, names=("x", "y", "yaw"), astra={"unit": ["m", "m", "rad"]}
    )
    parameters = {"timestep_s": TIMESTEP_S}

    def __init__(self, num_envs):
        self.state = torch.zeros(num_envs, 3)

    @staticmethod
    def abstraction(state):  # φ: of [x, y, yaw, v, w, tilt, tilt rate] keep the pose
        return state[..., :3]

    def reset_to(self, state, rows=None):
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)

    def step(self, command):
        (x, y, yaw), (v, w) = self.state.unbind(-1), command.unbind(-1)
        way = v * TIMESTEP_S
        self.state = torch.stack([x + way * yaw.cos(), y + way * yaw.sin(), yaw + w * TIMESTEP_S], dim=-1)
        return self.state


class Deliver(Objective):
    """Drive to the goal, 3 m away, without losing the payload."""

    action_size, goal_size = 2, 2

    def draw_starts(self, rng, count):
        return np.column_stack([np.zeros((count, 2)), rng.uniform(-np.pi, np.pi, count)])

    def draw_goals(self, rng, count):
        angle = rng.uniform(-np.pi, np.pi, count)
        return 3.0 * np.column_stack([np.cos(angle), np.sin(angle)])

    def observe(self, state, goal):  # the goal as the cart sees it
        x, y, yaw = state.unbind(-1)
        ahead, left = goal[..., 0] - x, goal[..., 1] - y
        cos, sin = yaw.cos(), yaw.sin()
        return torch.stack([cos * ahead + sin * left, cos * left - sin * ahead], dim=-1) / 3.0

    def reached(self, state, goal):
        return (state[:, :2] - goal).norm(dim=-1) < 0.3

    def reward(self, before, after, goal, failed):
        closer = (before[:, :2] - goal).norm(dim=-1) - (after[:, :2] - goal).norm(dim=-1)
        ends = self.success_reward * (self.reached(after, goal) & ~failed) + self.failure_reward * failed
        return closer + ends


TASK = Task(
    name="cart",
    timestep_s=TIMESTEP_S,
    state=Column("observation.state", size=7, names=("x", "y", "yaw", "v", "w", "tilt", "tilt_rate")),
    commands={"v": (-0.2, 1.0), "w": (-1.5, 1.5)},
    make_simulator=Unicycle,
    objective=Deliver(horizon=150),
)
