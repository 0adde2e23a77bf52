"""FetchPush of gymnasium-robotics by its id, and a planar gripper and puck without friction or height."""

from functools import partial

import numpy as np
from fetch import STEP_M, TIMESTEP_S

from astra_data import Column, Objective, Task
from astra_data.core.lazy import torch  # loads with its first use: `check` answers without it
from astra_data.worlds.gymnasium_env import GymnasiumRobot

CONTACT_M = 0.045  # from the gripper's axis to the puck's
PUSHING_HEIGHT_M, TABLE_M = 0.425, 0.40
NAMES = ("x", "y", "puck_x", "puck_y")


def in_the_plane(command, state):  # the height is kept, the fingers stay closed
    lift = np.clip((PUSHING_HEIGHT_M - state[2]) / STEP_M, -1.0, 1.0)
    return np.array([*command, lift, 0.0])


def fell(state, terminated):
    return state[5] < TABLE_M


class GripperAndPuck:
    abstract_state = Column("abstract.state", size=4, names=NAMES, astra={"unit": ["m"] * 4})
    parameters = {"timestep_s": TIMESTEP_S, "step_m": STEP_M, "contact_m": CONTACT_M}

    def __init__(self, num_envs, device="cpu"):
        self.state = torch.tensor([0.0, 0.0, 1.0, 0.0], device=device).repeat(num_envs, 1)

    @staticmethod
    def abstraction(state):  # φ: of gripper, puck, angles and speeds keep where both are in the plane
        return state[..., [0, 1, 3, 4]]

    def reset_to(self, state, rows=None):
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)

    def step(self, command):
        gripper = self.state[:, :2] + STEP_M * command
        away = self.state[:, 2:] - gripper
        distance = away.norm(dim=1, keepdim=True).clamp_min(1e-6)
        puck = gripper + away / distance * distance.clamp_min(CONTACT_M)
        self.state = torch.cat([gripper, puck], dim=1)
        return self.state


class Push(Objective):
    """Push the puck to within 5 cm of a place up to 15 cm from the middle along each axis."""

    action_size, goal_size = 2, 2
    center = np.array([1.342, 0.749])

    def draw_starts(self, rng, count):
        angle, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.1, 0.15, count)
        puck = self.center + distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return np.column_stack([np.tile(self.center, (count, 1)), puck])

    def draw_goals(self, rng, count):
        return self.center + rng.uniform(-0.15, 0.15, (count, 2))

    def observe(self, state, goal):
        gripper, puck = state[..., :2], state[..., 2:]
        return torch.cat([puck - gripper, goal - puck], dim=-1) / 0.1

    def reached(self, state, goal):
        return (state[:, 2:] - goal).norm(dim=1) < 0.05

    def far(self, state, goal):  # of the puck from the goal, and of the gripper from where it is to push
        puck = state[:, 2:]
        ahead = goal - puck
        behind = puck - 1.5 * CONTACT_M * ahead / ahead.norm(dim=1, keepdim=True).clamp_min(1e-6)
        return 10.0 * ahead.norm(dim=1) + 5.0 * (state[:, :2] - behind).norm(dim=1)

    def reward(self, before, after, goal, failed):
        ends = self.success_reward * (self.reached(after, goal) & ~failed) + self.failure_reward * failed
        return self.far(before, goal) - self.far(after, goal) + ends


TASK = Task(
    name="fetch_push",
    timestep_s=TIMESTEP_S,
    state=Column("observation.state", size=25),
    commands={"x": (-1.0, 1.0), "y": (-1.0, 1.0)},
    make_simulator=GripperAndPuck,
    quantities={"gripper_m": (0, 1), "ball_position_m": (2, 3)},
    objective=Push(horizon=100, success_reward=5.0, failure_reward=-5.0),
    robot=partial(GymnasiumRobot, "gymnasium_robotics:FetchPush-v4", command=in_the_plane, failed=fell),
)
