"""The Fetch arm of gymnasium-robotics, as far as its tasks share it."""

from functools import partial

from gymnasium_robotics.utils import mujoco_utils

STEP_M = 0.05  # by which a command of 1 moves the gripper's set point
TIMESTEP_S = 0.04


def _read(model, data, name, field):
    return getattr(data.joint(name), field).copy()


def _write(model, data, name, value, field):
    getattr(data.joint(name), field)[:] = value


# gymnasium-robotics 1.4 compares types of joints in a way that fails with new releases of MuJoCo.
for field in ("qpos", "qvel"):
    setattr(mujoco_utils, f"get_joint_{field}", partial(_read, field=field))
    setattr(mujoco_utils, f"set_joint_{field}", partial(_write, field=field))
