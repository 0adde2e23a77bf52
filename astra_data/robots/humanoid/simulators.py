"""The humanoid's abstract simulators: a planar walker, see walker2d.xml, joints alone, and joints with the body."""

from collections.abc import Mapping
from copy import copy
from importlib.resources import files

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from astra_data.dataset.columns import ABSTRACT_STATE
from astra_data.robots.humanoid import abstraction as phi
from astra_data.robots.humanoid import target as humanoid
from astra_data.worlds.simulators import ColdSteps, FreeStates
from astra_data.worlds.task import column, entries


def walker_model() -> mujoco.MjModel:
    """Build the walker; qpos (7): x, z and pitch of the torso, left hip, left knee, right hip, right knee."""
    return mujoco.MjModel.from_xml_path(str(files("astra_data.robots.humanoid") / "walker2d.xml"))


_LEG_M = (
    (-0.00902000647996384, -0.4649974000155199),
    (0.003063963232245122, -0.3829877440980478),
    (0.002959964480236801, -0.3699881600947197),
)
"""x and z from torso to hip, hip to knee and knee to foot of a stretched leg of the humanoid."""


def sole_clearance(pose: Tensor) -> Tensor:
    """Return heights of left and right sole above the floor, (..., 2), of `pose` (..., 6): z, pitch, hips and knees."""
    height, pitch, hip, knee = pose[..., :1], pose[..., 1:2], pose[..., [2, 4]], pose[..., [3, 5]]
    for (x, z), angle in zip(_LEG_M, (pitch, pitch + hip, pitch + hip - knee), strict=True):
        height = height - x * torch.sin(angle) + z * torch.cos(angle)
    return height - humanoid.FOOT_RADIUS_M


_POSE, _MOTION, _CONTACTS = slice(0, 6), slice(0, 13), slice(13, 15)
_HEADED, _OF_JOINTS, _OF_BODY = (("heading", "invariant"), ("joint", "invariant"), ("body", "invariant"))


class HumanoidWalker2d(FreeStates):
    """B walkers, states (B, 15); action: angles of left hip, left knee, right hip, right knee (B, 4), clipped to ±1."""

    action_size = 4
    abstract_state = column(
        ABSTRACT_STATE,
        [
            *(*entries("z", "m", *_HEADED), *entries("pitch", "rad", *_HEADED)),
            *entries("left_hip left_knee right_hip right_knee", "rad", *_OF_JOINTS),
            *(*entries("vx vz", "m/s", *_HEADED), *entries("pitch_rate", "rad/s", *_HEADED)),
            *entries("left_hip_rate left_knee_rate right_hip_rate right_knee_rate", "rad/s", *_OF_JOINTS),
            *entries("left_contact right_contact", "1", "world", "invariant"),
        ],
        "torso, legs and foot contacts of a planar walker",
    )
    abstraction = phi.humanoid_to_walker2d

    def __init__(self, num_envs: int, *, num_threads: int | None = None, device: str = "cpu") -> None:
        standing = phi.humanoid_to_walker2d(torch.tensor(humanoid.STANDING))
        super().__init__(standing.repeat(num_envs, 1).to(device))
        self.memory = self._sunk(self.state)
        self.ranges = humanoid.CommandRanges()
        self._model = walker_model()
        self._models = [self._model]
        self._steps = ColdSteps(self._model, num_envs, num_threads)

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {"timestep_s": humanoid.TIMESTEP_S, **self.ranges.parameters}

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use factors (B, 1) on the joints' damping and on the control step, of as many physics steps, from now on."""
        plain = self._model
        if self._models[0] is plain:
            self._models = [copy(plain) for _ in self.state]
        friction, timestep_scale = (parameters[name][:, 0].tolist() for name in ("friction", "timestep_scale"))
        for model, factor, scale in zip(self._models, friction, timestep_scale, strict=True):
            model.dof_damping[:] = factor * plain.dof_damping
            model.opt.timestep = scale * plain.opt.timestep

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, 15), on floors below their feet."""
        super().reset_to(state, rows)
        sunk = self._sunk(state)
        self.memory = sunk if rows is None else self.memory.index_copy(0, rows, sunk)

    @staticmethod
    def _sunk(state: Tensor) -> Tensor:
        """Return the depth of the lower foot in the floor, (B, 1) float64 in m."""
        return (-sole_clearance(state[:, _POSE].double()).amin(-1, keepdim=True)).clamp_min(0.0)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move to `landed` (B, 15), its contacts rounded to 1 or 0; return it."""
        contacts = (landed[:, _CONTACTS] > 0.5).to(landed.dtype)
        return super().settle(before, torch.cat([landed[:, _MOTION], contacts], dim=-1))

    def step(self, action: Tensor) -> Tensor:
        """Follow the commands `action` (B, 4) for one control step; return the new state (B, 15)."""
        motion, sunk = self.state[:, _MOTION].cpu().double(), self.memory[:, 0].cpu()
        motion[:, 0] += sunk
        targets = self.ranges.targets(action.cpu().double()).numpy()
        # Before z comes x, which is 0 at the start of every step.
        placed = np.pad(motion.numpy(), ((0, 0), (1, 0)))
        landed = self._steps(self._models, placed, targets, substeps=humanoid.CONTROL_SUBSTEPS)
        motion = torch.from_numpy(landed[:, 1:].copy())
        contacts = (sole_clearance(motion[:, _POSE]) < humanoid.CONTACT_M).to(motion.dtype)
        motion[:, 0] -= sunk
        self.state = torch.cat([motion, contacts], dim=-1).float().to(self.state.device)
        return self.state


_COUNT = len(humanoid.JOINTS)
_CENTER, _VELOCITY, _UP, _SPIN = (slice(first, first + 3) for first in range(2 * _COUNT, 2 * _COUNT + 12, 3))
_JOINTS = [
    *entries(" ".join(humanoid.JOINTS), "rad", *_OF_JOINTS),
    *entries(" ".join(f"{name}_rate" for name in humanoid.JOINTS), "rad/s", *_OF_JOINTS),
]


class HumanoidKinematics(FreeStates):
    """B humanoids' joints, (B, 34); action: angles of left hip and knee, right hip and knee, (B, 4), clipped to ±1."""

    action_size = 4
    abstract_state = column(ABSTRACT_STATE, _JOINTS, "angles and rates of all joints")
    abstraction = phi.humanoid_to_kinematics

    ranges = humanoid.CommandRanges()  # joint angles of commands

    def __init__(self, num_envs: int, *, device: str = "cpu") -> None:
        standing = type(self).abstraction(torch.tensor(humanoid.STANDING))
        super().__init__(standing.repeat(num_envs, 1).to(device))
        self._damping = torch.from_numpy(humanoid.humanoid_model().dof_damping[-_COUNT:]).float().to(device)
        self._approach = humanoid.STIFFNESS / (humanoid.DAMPING + self._damping)
        self._timestep_s = torch.tensor(humanoid.TIMESTEP_S, device=device)

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {"timestep_s": humanoid.TIMESTEP_S, **self.ranges.parameters}

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use factors (B, 1) on the joints' damping and on the control step from the next step on."""
        self._approach = humanoid.STIFFNESS / (humanoid.DAMPING + parameters["friction"] * self._damping)
        self._timestep_s = humanoid.TIMESTEP_S * parameters["timestep_scale"]

    def step(self, action: Tensor) -> Tensor:
        """Follow the commands `action` (B, 4) for one control step; return the new state (B, X)."""
        self.state = self._moved(action)
        return self.state

    def _moved(self, action: Tensor) -> Tensor:
        """Return angles and rates (B, 34) of all joints after the step."""
        angles = self.state[:, :_COUNT]
        target = torch.zeros_like(angles)
        target[:, humanoid.COMMANDED] = self.ranges.targets(action)
        left = (target - angles) * torch.exp(-self._approach * self._timestep_s)
        return torch.cat([target - left, self._approach * left], dim=-1)


class HumanoidExtendedKinematics(HumanoidKinematics):
    """The same, with the center of mass and its velocity, and lean and angular velocity of the torso, (B, 46)."""

    abstract_state = column(
        ABSTRACT_STATE,
        [
            *(*_JOINTS, *entries("mass_x mass_y mass_z", "m", *_HEADED)),
            *entries("mass_vx mass_vy mass_vz", "m/s", *_HEADED),
            *(*entries("up_x up_y up_z", "1", *_OF_BODY), *entries("wx wy wz", "rad/s", *_OF_BODY)),
        ],
        "angles and rates of all joints; along the heading, centre of mass, from between the feet, "
        "and its velocity; which way is up from the torso, and how fast it turns",
    )
    abstraction = phi.humanoid_to_extended_kinematics

    def __init__(self, num_envs: int, *, follow_s: float = 0.3, device: str = "cpu") -> None:
        """Build B standing humanoids; `follow_s` is the time constant of the body's velocity and angular velocity."""
        super().__init__(num_envs, device=device)
        self.follow_s = follow_s

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {**super().parameters, "follow_s": self.follow_s}

    def _moved(self, action: Tensor) -> Tensor:
        """Return joints, center of mass and its velocity, lean and spin (B, 46) after the step."""
        joints = super()._moved(action)
        mass, feet = phi.mass_and_feet(self.state[:, :_COUNT])
        later_mass, later_feet = phi.mass_and_feet(joints[:, :_COUNT])
        aside = (later_mass - later_feet.mean(1)) - (mass - feet.mean(1))
        stance = feet[..., 2].argmin(dim=-1)
        rows = torch.arange(len(feet), device=feet.device)
        driven = ((later_mass - later_feet[rows, stance]) - (mass - feet[rows, stance])) / self._timestep_s
        share = -torch.expm1(-self._timestep_s / self.follow_s)
        velocity = torch.lerp(self.state[:, _VELOCITY], driven, share)
        shift = torch.cat([aside[:, :2], velocity[:, 2:] * self._timestep_s], dim=-1)
        spin = (1.0 - share) * self.state[:, _SPIN]
        up = self.state[:, _UP]
        up = functional.normalize(up - self._timestep_s * torch.linalg.cross(spin, up), dim=-1)
        return torch.cat([joints, self.state[:, _CENTER] + shift, velocity, up, spin], dim=-1)
