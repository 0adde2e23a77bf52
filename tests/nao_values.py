"""Values of the NAO that tests compare with."""

import mujoco
import numpy as np

from astra_data.core.arrays import Floats
from astra_data.robots.nao.robot import nao_model
from astra_data.robots.nao.tasks import PerceptionErrors
from astra_data.robots.nao.walk import FOOT_HEIGHT_M, TO_MOTORS, TraitSpread

NO_ERRORS = PerceptionErrors(*(0.0,) * 3, 2.0, 0.0, (0.0, 0.0), *(0.0,) * 4, 0.5, 0.0, np.pi, 0.0)
"""Exact estimates."""
IDENTICAL = TraitSpread(0.0, 0.0, (2, 2), (0.6, 0.6), 0.0, (1.0, 1.0))
"""All robots alike, without noise."""


def foot_poses(angles: Floats) -> Floats:
    """Return where MuJoCo has the soles, as poses (..., 2, 6), at the eleven `angles` (..., 11) in rad."""
    model = nao_model()
    data = mujoco.MjData(model)
    poses = []
    for row in angles.reshape(-1, 11):
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        data.qpos[7:] = row[TO_MOTORS]
        mujoco.mj_kinematics(model, data)
        for side in "LR":
            body = data.body(f"{side}AnkleRoll")
            turn = body.xmat.reshape(3, 3)
            sole = body.xpos - FOOT_HEIGHT_M * turn[:, 2]
            roll, yaw = np.arctan2(turn[2, 1], turn[2, 2]), np.arctan2(turn[1, 0], turn[0, 0])
            poses.append([*sole, roll, np.arcsin(-turn[2, 0]), yaw])
    return np.array(poses).reshape(*angles.shape[:-1], 2, 6)
