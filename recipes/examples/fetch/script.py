"""A pusher written by hand, as a row: what the arm can reach, by a policy that learned nothing."""

import numpy as np

from astra_data.core.lazy import torch  # loads with its first use: `check` answers without it
from astra_data.methods.method import Method
from astra_data.policies.train import UserLearner

REACH_M = 0.045  # from the gripper's axis to the puck's


class Script:
    kind = "scripted pusher"

    def act(self, observation):  # (B, 4): puck from the gripper, goal from the puck, in 0.1 m
        gripper, ahead = -0.1 * observation[:, :2], 0.1 * observation[:, 2:]  # from the puck
        way = ahead / (np.linalg.norm(ahead, axis=1, keepdims=True) + 1e-9)
        along = (gripper * way).sum(axis=1, keepdims=True)
        aside = gripper - along * way
        off = np.linalg.norm(aside, axis=1, keepdims=True)
        left = np.stack([-way[:, 1], way[:, 0]], axis=1)
        around = 1.8 * REACH_M * np.where(off > 1e-3, aside / (off + 1e-9), left) - 1.2 * REACH_M * way
        behind, through = -1.5 * REACH_M * way, 0.02 * way
        place = np.where(along > -REACH_M, around, behind)
        place = np.where((along < -0.5 * REACH_M) & (off < 0.012), through, place)
        return np.clip((place - gripper) / 0.05, -1.0, 1.0)

    def to_file(self):
        return {"reach_m": torch.tensor([REACH_M])}, {}

    @classmethod
    def from_file(cls, tensors, metadata):
        return cls()


METHOD = Method(
    name="script",
    title="Script",
    role="ceiling",
    color="#555555",
    learn=UserLearner(learn=lambda env, training: Script(), policy=Script),
)
