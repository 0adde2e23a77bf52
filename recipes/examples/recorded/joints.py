"""Joints that follow targets, from their own logs: an abstract simulator of a first-order response.

python joints.py ANYMAL pace-anymal     writes pace-joints-steps: steps of 4 rows, at 400 Hz
python joints.py ICUB icub-walking      writes icub-joints-steps; its logs hold no targets
"""

import math
import sys
from functools import partial

import numpy as np
import torch
from steps import Recorded, write_steps

from astra_data import Column, Task
from astra_data.worlds.simulators import FreeStates

LEGS = [f"{leg}_{joint}" for leg in ("LF", "RF", "LH", "RH") for joint in ("HAA", "HFE", "KFE")]
SIDES = [
    f"{side}_{joint}"
    for side in "lr"
    for joint in ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
]
STILL_RAD = 0.05
"""A second in which no joint moves farther shows nothing."""


class Joints(FreeStates):
    """Joints [positions; how far each moved in the last step], in rad.

    In a step they cover the share 1 - exp(-timestep_s / time_constant_s) of the way to their targets: all of
    it where the time constant is 0, and nothing without targets.
    """

    def __init__(self, num_envs, joints, timestep_s, time_constant_s, device="cpu"):
        self.joints, self.parameters = joints, {"timestep_s": timestep_s}
        share = 1.0 - math.exp(-timestep_s / time_constant_s) if time_constant_s else 1.0
        self.share = 0.0 if time_constant_s is None else share
        super().__init__(torch.zeros(num_envs, 2 * joints, device=device))

    def step(self, target):
        place = self.state[:, : self.joints]
        moved = self.share * (target - place)
        self.state = torch.cat([place + moved, moved], dim=-1)
        return self.state


def task(name, joints, timestep_s, time_constant_s=None):
    """Return the task of `joints`; without a time constant, that of logs without targets."""
    column = Column(
        "abstract.state",
        size=2 * len(joints),
        names=(*joints, *(f"{joint}_moved" for joint in joints)),
        astra={"unit": ["rad"] * 2 * len(joints)},
    )
    targets = joints if time_constant_s is not None else ["none"]
    return Task(
        name=name,
        timestep_s=timestep_s,
        state=column,
        abstract_state=column,
        abstraction=lambda state: state,
        commands=dict.fromkeys(targets, (-math.pi, math.pi)),
        make_simulator=partial(Joints, joints=len(joints), timestep_s=timestep_s, time_constant_s=time_constant_s),
        objective=Recorded([0.0] * column.size, len(targets)),
        quantities={"joints_rad": tuple(range(len(joints)))},
    )


ANYMAL = task("pace-joints", LEGS, 4 / 400, time_constant_s=0.0)
ICUB = task("icub-joints", SIDES, 1 / 99)


def states(place):
    """Return positions before each step but the first, and the motions in the step before."""
    return np.column_stack([place[1:], np.diff(place, axis=0)])


def stretches(state, fps):
    """Yield first and last row of each second in which a joint moves."""
    for first in range(0, len(state) - fps, fps):
        if np.ptp(state[first : first + fps], axis=0).max() > STILL_RAD:
            yield first, first + fps


if __name__ == "__main__":
    wanted = {"ANYMAL": (ANYMAL, 4), "ICUB": (ICUB, 1)}[sys.argv[1]]
    write_steps(wanted[0], *sys.argv[2:], states=states, stretches=stretches, rows=wanted[1])
