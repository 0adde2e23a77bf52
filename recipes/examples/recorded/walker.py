"""A walking robot in the plane, from its own logs: an abstract simulator that does at once what it is told.

python walker.py nao-guda           writes nao-walk-steps and holds out a quarter of the stretches
python walker.py traj scoring       learns from one recording, and holds out all of the other
"""

import sys

import numpy as np
import torch
from steps import Recorded, write_steps

from astra_data import Column, Task
from astra_data.worlds.simulators import FreeStates

ROWS, FPS = 10, 60
STEP_S = ROWS / FPS
FASTEST = torch.tensor([[0.15, 0.25], [0.20, 0.20], [2.094, 2.094]])
"""Backward and forward, right and left in m/s, both turns in rad/s (BadgerRLSystemCodeRelease2023)."""
JUMP_M, JUMP_RAD, CARRIED_M_S = 0.06, 0.1, 0.6
"""Between two rows a larger change is self-localization that corrects itself; a robot that is faster over
half a second is carried."""
START, ROLES = [0.0, 0.0, 1.0] + [0.0] * 4, ["position"] * 2 + ["heading"] * 2 + ["invariant"] * 3


class PlanarWalker(FreeStates):
    """Bodies [x, y, heading before the last step; forward, left, turn in it, in the body's frame]; m, rad.

    So what is learned of motions holds anywhere. Not modeled: legs, the delay of the walk, kicks.
    """

    abstract_state = Column(
        "abstract.state",
        size=7,
        names=("x", "y", "heading_x", "heading_y", "forward", "left", "turn"),
        astra={"unit": ["m", "m", "1", "1", "m", "m", "rad"], "role": ROLES},
    )
    parameters = {"timestep_s": STEP_S}

    def __init__(self, num_envs, device="cpu"):
        super().__init__(torch.tensor(START, device=device).repeat(num_envs, 1))

    @staticmethod
    def abstraction(state):
        return state

    def step(self, action):
        x, y, heading_x, heading_y, forward, left, turn = self.state.unbind(-1)
        cos, sin = turn.cos(), turn.sin()
        pose = [
            x + heading_x * forward - heading_y * left,
            y + heading_y * forward + heading_x * left,
            heading_x * cos - heading_y * sin,
            heading_y * cos + heading_x * sin,
        ]
        self.state = torch.cat([torch.stack(pose, dim=-1), self.motion(action)], dim=-1)
        return self.state

    @staticmethod
    def motion(action):
        """Return forward, left and turn (B, 3) of the policy's (turn, forward, left, kick), (B, 4) in ±1.

        As in the robot's NeuralControl.cpp: 0.6 of the turn, half of a backward action, and 0.8 f + 0.2 of a
        forward action f; here along the arc of a constant velocity.
        """
        turn, forward, left, _ = action.unbind(-1)
        share = torch.stack([torch.where(forward > 0, 0.8 * forward + 0.2, 0.5 * forward), left, 0.6 * turn], -1)
        least, largest = FASTEST.to(action.device).unbind(-1)
        ahead, aside, turned = (share * torch.where(share > 0, largest, least) * STEP_S).unbind(-1)
        along, across = torch.sinc(turned / torch.pi), torch.sinc(turned / 2 / torch.pi) * (turned / 2).sin()
        return torch.stack([along * ahead - across * aside, across * ahead + along * aside, turned], dim=-1)


TASK = Task(
    name="nao-walk",
    timestep_s=STEP_S,
    state=PlanarWalker.abstract_state,
    commands=dict.fromkeys(("turn", "forward", "left", "kick"), (-1.0, 1.0)),
    make_simulator=PlanarWalker,
    objective=Recorded(START, action_size=4),
    quantities={"place_m": (0, 1), "heading": (2, 3), "moved_m": (4, 5), "turned_rad": (6,)},
)


def states(pose):
    """Return states (T + 1, 7), relative to the first, of poses [x, y, yaw, ...] (T + 2, 5)."""
    yaw = pose[:, 2] - pose[0, 2]
    place = _turned(pose[:, :2] - pose[0, :2], -pose[0, 2])
    motion = _turned(np.diff(place, axis=0), -yaw[:-1])
    turn = (np.diff(yaw) + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([place[:-1], np.cos(yaw[:-1]), np.sin(yaw[:-1]), motion, turn])


def _turned(places, angle):
    (x, y), cos, sin = places.T, np.cos(angle), np.sin(angle)
    return np.column_stack([cos * x - sin * y, sin * x + cos * y])


def stretches(state, fps):
    """Yield first and last row of each stretch of walking, without jumps and not carried."""
    moved = np.linalg.norm(np.diff(state[:, :2], axis=0), axis=1)
    turn = (np.diff(state[:, 2]) + np.pi) % (2 * np.pi) - np.pi
    broken, half = (moved > JUMP_M) | (abs(turn) > JUMP_RAD), fps // 2
    far = np.linalg.norm(state[half:, :2] - state[:-half, :2], axis=1) > CARRIED_M_S * half / fps
    for first in np.flatnonzero(far):
        broken[first : first + half] = True
    ends = np.flatnonzero(np.diff(np.concatenate([[True], broken, [True]]).astype(int)))
    yield from ends.reshape(-1, 2)


if __name__ == "__main__":
    write_steps(TASK, *sys.argv[1:], states=states, stretches=stretches, rows=ROWS)
