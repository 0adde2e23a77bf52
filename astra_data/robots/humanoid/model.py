"""The humanoid's MuJoCo model, with its own motors or with position control of every joint.

Four joints follow commands: hips and knees, each about one axis. All others are held at zero.
"""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

JOINTS = (
    *("abdomen_z", "abdomen_y", "abdomen_x"),
    *("right_hip_x", "right_hip_z", "right_hip_y", "right_knee"),
    *("left_hip_x", "left_hip_z", "left_hip_y", "left_knee"),
    *("right_shoulder1", "right_shoulder2", "right_elbow"),
    *("left_shoulder1", "left_shoulder2", "left_elbow"),
)
"""In the order of the state."""
COMMANDED = tuple(JOINTS.index(name) for name in ("left_hip_y", "left_knee", "right_hip_y", "right_knee"))
"""The commanded joints among all, in the order of actions."""
FEET = ("left_foot", "right_foot")
"""Geoms that are spheres at the ends of the shins."""
FOOT_RADIUS_M = 0.075

POSITIONS = 24
"""qpos: x, y, z, quaternion, 17 joint angles."""
STATE_SIZE = 47
"""qpos, then qvel (23): linear, angular, 17 joint rates."""
STANDING = (0.0, 0.0, 1.4, 1.0, *[0.0] * 43)
"""The state in which the model starts: upright, at rest, every joint at zero."""
CONTROL_SUBSTEPS = 5
"""Physics steps per control step: 5 x 0.003 s, as in Gymnasium."""
TIMESTEP_S = 0.015

STIFFNESS = 200.0
"""In N m/rad: the paper's proportional gain."""
DAMPING = 10.0
"""In N m s/rad: the paper's derivative gain."""
MOTOR_RANGE = 0.4
"""Gymnasium's motors take controls of ±0.4, times their gear the torque in N m."""

CONTACT_M = 0.002
"""A foot touches the floor when its sole is closer to it than this: the sum of both margins in the model."""

Actuators = Literal["positions", "motors"]


def humanoid_model(actuators: Actuators = "positions") -> mujoco.MjModel:
    """Load Gymnasium's humanoid.

    With "motors" it is unchanged. With "positions", controls are joint angles in rad that MuJoCo holds with
    the paper's gains in every physics step, with torques up to those of the motors. If torques were computed
    only once per control step, the same gains would make the joints chatter.
    """
    path = Path(str(files("gymnasium.envs.mujoco") / "assets" / "humanoid.xml"))
    model = mujoco.MjModel.from_xml_path(str(path))
    if actuators == "positions":
        torque = MOTOR_RANGE * model.actuator_gear[:, 0]
        model.actuator_gear[:, 0] = 1.0
        model.actuator_gainprm[:, 0] = STIFFNESS
        model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
        model.actuator_biasprm[:, 1:3] = -STIFFNESS, -DAMPING
        model.actuator_ctrllimited[:] = False
        model.actuator_forcelimited[:] = True
        model.actuator_forcerange[:] = np.stack([-torque, torque], axis=1)
    return model


@dataclass(frozen=True)
class CommandRanges:
    """Joint angles in degrees of the commands -1 and 1; not in the paper.

    Random commands over the joints' full ranges make the humanoid fall in 19 control steps, over these in 65.
    """

    hip_deg: tuple[float, float] = (-50.0, 20.0)
    knee_deg: tuple[float, float] = (-70.0, -2.0)

    @property
    def parameters(self) -> dict[str, float]:
        """The ends of the ranges by name, as datasets record them."""
        ranges = {"hip": self.hip_deg, "knee": self.knee_deg}
        return {
            f"{name}_{end}_deg": value
            for name, ends in ranges.items()
            for end, value in zip(("low", "high"), ends, strict=True)
        }

    def targets(self, action: Tensor) -> Tensor:
        """Return the angles (..., 4) in rad of commands (..., 4), clipped to ±1."""
        low, high = self._ends(action)
        return low + (high - low) * (action.clamp(-1.0, 1.0) + 1.0) / 2.0

    def commands(self, target: Tensor) -> Tensor:
        """Return the commands (..., 4) of angles (..., 4) in rad."""
        low, high = self._ends(target)
        return 2.0 * (target - low) / (high - low) - 1.0

    def _ends(self, like: Tensor) -> tuple[Tensor, Tensor]:
        ends = torch.tensor([self.hip_deg, self.knee_deg] * 2, dtype=like.dtype, device=like.device)
        low, high = torch.deg2rad(ends).unbind(-1)
        return low, high
