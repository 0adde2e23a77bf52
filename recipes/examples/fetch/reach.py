"""FetchReach of gymnasium-robotics by its id, and a point that does at once what it is told."""

from functools import partial

import numpy as np
from fetch import STEP_M, TIMESTEP_S

from astra_data import Column, Objective, Task
from astra_data.core.lazy import torch  # loads with its first use: `check` answers without it
from astra_data.worlds.gymnasium_env import GymnasiumRobot

AXES = {"names": ("x", "y", "z"), "astra": {"unit": ["m"] * 3}}


def four(command, state):
    return np.append(command, 0.0)  # the fingers stay closed


class Point:
    abstract_state = Column("abstract.state", size=3, **AXES)
    parameters = {"timestep_s": TIMESTEP_S, "step_m": STEP_M}

    def __init__(self, num_envs, device="cpu"):
        self.state = torch.zeros(num_envs, 3, device=device)

    @staticmethod
    def abstraction(state):  # φ: of gripper, fingers and their velocities keep where the gripper is
        return state[..., :3]

    def reset_to(self, state, rows=None):
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)

    def step(self, command):
        self.state = self.state + STEP_M * command
        return self.state


class Reach(Objective):
    """Come within 2 cm of a point up to 15 cm away along each axis."""

    action_size, goal_size = 3, 3
    center = np.array([1.342, 0.749, 0.535])

    def draw_starts(self, rng, count):
        return np.tile(self.center, (count, 1))

    def draw_goals(self, rng, count):
        return self.center + rng.uniform(-0.15, 0.15, (count, 3))

    def observe(self, state, goal):
        return (goal - state) / 0.1

    def reached(self, state, goal):
        return (goal - state).norm(dim=1) < 0.02

    def reward(self, before, after, goal, failed):
        nearer = (goal - before).norm(dim=1) - (goal - after).norm(dim=1)
        return 10.0 * nearer - 0.05 + self.success_reward * self.reached(after, goal)


TASK = Task(
    name="fetch_reach",
    timestep_s=TIMESTEP_S,
    state=Column("observation.state", size=10),
    commands={"x": (-1.0, 1.0), "y": (-1.0, 1.0), "z": (-1.0, 1.0)},
    make_simulator=Point,
    objective=Reach(horizon=50, success_reward=2.0),
    robot=partial(GymnasiumRobot, "gymnasium_robotics:FetchReach-v4", command=four),
)
