"""A cart with a payload that tips: the task, and a kinematic unicycle as its abstract simulator."""

import numpy as np

from astra_data import Column, Objective, Task
from astra_data.core.lazy import torch  # loads with its first use: `check` answers without it

TIMESTEP_S = 0.1
DOCK_M = (3.0, 0.0)
POSE = {"names": ("x", "y", "heading_x", "heading_y"), "astra": {"unit": ["m", "m", "1", "1"]}}


class Unicycle:
    """Carts [x, y, heading] that do at once what they are told, and carry nothing."""

    abstract_state = Column("abstract.state", size=4, **POSE)
    parameters = {"timestep_s": TIMESTEP_S}

    def __init__(self, num_envs, device="cpu"):
        self.state = torch.tensor([0.0, 0.0, 1.0, 0.0], device=device).repeat(num_envs, 1)

    @staticmethod
    def abstraction(state):  # φ: of [pose, v, w, tilt, tilt rate] keep the pose
        return state[..., :4]

    def reset_to(self, state, rows=None):
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)

    def step(self, command):
        (x, y, heading_x, heading_y), (v, w) = self.state.unbind(-1), command.unbind(-1)
        yaw, way = torch.atan2(heading_y, heading_x), v * TIMESTEP_S
        turned = yaw + w * TIMESTEP_S
        self.state = torch.stack([x + way * yaw.cos(), y + way * yaw.sin(), turned.cos(), turned.sin()], -1)
        return self.state


class Deliver(Objective):
    """Drive to the dock, 3 m away, without losing the payload."""

    action_size = 2

    def draw_starts(self, rng, count):
        yaw = rng.uniform(-np.pi, np.pi, count)
        return np.column_stack([np.zeros((count, 2)), np.cos(yaw), np.sin(yaw)])

    def observe(self, state, goal):  # the dock as the cart sees it
        x, y, heading_x, heading_y = state.unbind(-1)
        east, north = DOCK_M[0] - x, DOCK_M[1] - y
        ahead, left = heading_x * east + heading_y * north, heading_x * north - heading_y * east
        return torch.stack([ahead, left], dim=-1) / 3.0

    def places(self, state):  # x and y in m, for the figure of paths
        return state[..., :2]

    def far(self, state):
        return (state[:, :2] - state.new_tensor(DOCK_M)).norm(dim=-1)

    def reached(self, state, goal):
        return self.far(state) < 0.3

    def reward(self, before, after, goal, failed):
        ends = self.success_reward * (self.reached(after, goal) & ~failed) + self.failure_reward * failed
        return self.far(before) - self.far(after) + ends


TASK = Task(
    name="cart",
    timestep_s=TIMESTEP_S,
    state=Column("observation.state", size=8, names=(*POSE["names"], "v", "w", "tilt", "tilt_rate")),
    commands={"v": (-0.2, 1.0), "w": (-1.5, 1.5)},
    make_simulator=Unicycle,
    objective=Deliver(horizon=150, failure_reward=-3.0),
)
