"""The humanoid's MuJoCo model, the spreads of its states, and the rewards of walking.

Its own motors move it, or position control of every joint. Four joints follow commands: hips and knees, each
about one axis. All others are held at zero.
"""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from astra_data.core.arrays import Bools, Floats, normalized

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
        ends = torch.tensor([self.hip_deg, self.knee_deg] * 2, dtype=action.dtype, device=action.device)
        low, high = torch.deg2rad(ends).unbind(-1)
        return low + (high - low) * (action.clamp(-1.0, 1.0) + 1.0) / 2.0


JOINTS_RAD = tuple(0.3 if joint in COMMANDED else 0.025 for joint in range(len(JOINTS)))
JOINT_RATES_RAD_S = tuple(2.5 if joint in COMMANDED else 0.6 for joint in range(len(JOINTS)))
POSITION_M = 0.07
VELOCITY_M_S = 0.3
LEAN_RAD = 0.1
SPIN_RAD_S = 1.0

_QUATERNION_SPREAD = 0.2
_STATE = (
    *([POSITION_M] * 3 + [_QUATERNION_SPREAD] * 4),
    *JOINTS_RAD,
    *([VELOCITY_M_S] * 3 + [SPIN_RAD_S] * 3),
    *JOINT_RATES_RAD_S,
)


def in_spreads(state: Tensor) -> Tensor:
    """Return the deviations of target states (..., 47) from standing, clipped at 5 spreads, (..., 47)."""
    return normalized(state, state.new_tensor(STANDING), state.new_tensor(_STATE))


_QUATERNION = slice(3, 7)


@dataclass(frozen=True)
class Locomotion:
    """Rewards, starts and ends of episodes.

    Attributes:
        forward_reward: per m/s of the center of mass along x. healthy_reward: for every step that ends at a
        healthy height. healthy_m: range of healthy heights of the torso, outside of which the episode ends.
        effort_cost: per unit of the sum of the squared controls. contact_cost: per unit of the sum of the
        squared contact forces and torques. contact_cost_limit: the largest contact cost of a step.
        reset_noise: half width of the uniform noise on positions and velocities at the start.
    """

    forward_reward: float = 1.25
    healthy_reward: float = 5.0
    healthy_m: tuple[float, float] = (1.0, 2.0)
    effort_cost: float = 0.1
    contact_cost: float = 5e-7
    contact_cost_limit: float = 10.0
    reset_noise: float = 0.01

    def draw_starts(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw target states (count, 47): almost upright and at rest."""
        noise = rng.uniform(-self.reset_noise, self.reset_noise, (count, len(STANDING)))
        state = np.array(STANDING) + noise
        state[:, _QUATERNION] /= np.linalg.norm(state[:, _QUATERNION], axis=1, keepdims=True)
        return state

    def healthy(self, height: Floats) -> Bools:
        """Return which torso heights (B,) in m are healthy."""
        low, high = self.healthy_m
        return np.asarray((height > low) & (height < high))

    def reward(self, velocity: Floats, healthy: Bools, effort: Floats, contact: Floats) -> Floats:
        """Return the reward (B,) of a step.

        Args:
            velocity: of the center of mass along x, (B,) in m/s.
            healthy: after the step, (B,).
            effort: sum of the squared controls, (B,).
            contact: sum of the squared contact forces and torques of all bodies, (B,).
        """
        cost = self.effort_cost * effort
        cost = cost + np.minimum(self.contact_cost * contact, self.contact_cost_limit)
        return np.asarray(self.forward_reward * velocity + self.healthy_reward * healthy - cost)
