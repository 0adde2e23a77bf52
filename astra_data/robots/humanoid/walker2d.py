"""The most abstract simulator of the humanoid: a walker in the plane of x and z, legs under one rigid link.

Its MuJoCo model has the lengths, masses, joints and motors of the humanoid's in its initial pose, the same
physics and position control. What it leaves out: docs/humanoid.md.
"""

from collections.abc import Mapping
from copy import copy
from functools import cache

import mujoco
import numpy as np
import torch
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.dataset.columns import ABSTRACT_STATE, Column
from astra_data.robots.humanoid.abstraction import humanoid_to_walker2d
from astra_data.robots.humanoid.model import (
    COMMANDED,
    CONTACT_M,
    CONTROL_SUBSTEPS,
    DAMPING,
    FEET,
    FOOT_RADIUS_M,
    JOINTS,
    STANDING,
    STIFFNESS,
    TIMESTEP_S,
    CommandRanges,
    humanoid_model,
)
from astra_data.worlds.batched_mujoco import attribute
from astra_data.worlds.simulators import ColdSteps, FreeStates

_MODEL = """
<mujoco model="planar walker">
  <compiler angle="radian"/>
  <option integrator="RK4" solver="PGS" iterations="50" timestep="0.003"/>
  <default>
    <geom condim="1" margin="0.001"/>
  </default>
  <worldbody>
    <geom type="plane" condim="3" friction="1 .1 .1" size="20 20 0.125"/>
    <body>
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 1 0"/>
      {upper}
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
_LEG = """
<body pos="{hip}">
  <joint name="{side}_hip" axis="0 1 0" {hip_joint}/>
  {thigh}
  <body pos="{knee}">
    <joint name="{side}_knee" axis="0 -1 0" {knee_joint}/>
    {shin}
    <body pos="{ankle}">{foot}</body>
  </body>
</body>
"""


def walker_model() -> mujoco.MjModel:
    """Build the walker; qpos (7): x, z and pitch of the torso, left hip, left knee, right hip, right knee.

    Controls are the targets of these four joints in rad, held as `humanoid_model` holds them.
    """
    return mujoco.MjModel.from_xml_string(_Mjcf().model())


class _Mjcf:
    """Writes parts of the humanoid, standing level with its torso at the origin, as MJCF."""

    def __init__(self) -> None:
        self.humanoid = humanoid_model()
        self.data = mujoco.MjData(self.humanoid)
        self.data.qpos[:3] = 0.0
        mujoco.mj_forward(self.humanoid, self.data)

    def model(self) -> str:
        legs = {
            self.humanoid.body(f"{side}_{part}").id
            for side in ("left", "right")
            for part in ("thigh", "shin", "foot")
        }
        rest = [body for body in range(1, self.humanoid.nbody) if body not in legs]
        head, hip = self.data.geom("head").xpos, self.data.joint("left_hip_y").xanchor
        trunk = f'<geom type="capsule" size="0.07" fromto="{attribute([hip[0], 0, hip[2], *head])}"/>'
        upper = [self._inertia(rest, np.zeros(3)), trunk, self._leg("left"), self._leg("right")]
        names = ("left_hip", "left_knee", "right_hip", "right_knee")
        actuators = []
        for number, name in zip(COMMANDED, names, strict=True):
            torques = attribute(self.humanoid.actuator_forcerange[number])
            gains = f'kp="{STIFFNESS}" kv="{DAMPING}"'
            actuators.append(f'<position joint="{name}" {gains} forcerange="{torques}"/>')
        return _MODEL.format(upper="\n".join(upper), actuators="\n".join(actuators))

    def _leg(self, side: str) -> str:
        hip, knee = (self.data.joint(f"{side}_{name}").xanchor for name in ("hip_y", "knee"))
        foot = self.data.body(f"{side}_foot").xpos
        return _LEG.format(
            side=side,
            hip=attribute(hip),
            knee=attribute(knee - hip),
            ankle=attribute(foot - knee),
            hip_joint=self._joint(f"{side}_hip_y"),
            knee_joint=self._joint(f"{side}_knee"),
            thigh=self._part(f"{side}_thigh", hip),
            shin=self._part(f"{side}_shin", knee),
            foot=self._part(f"{side}_foot", foot),
        )

    def _joint(self, name: str) -> str:
        joint = self.humanoid.joint(name)
        words = {key: float(getattr(joint, key)[0]) for key in ("armature", "damping", "stiffness")}
        attributes = " ".join(f'{key}="{value!r}"' for key, value in words.items())
        return f'{attributes} limited="true" range="{attribute(joint.range)}"'

    def _part(self, name: str, origin: Floats) -> str:
        """Return the body `name` in a frame at `origin`."""
        body = self.humanoid.body(name).id
        geom = int(self.humanoid.body_geomadr[body])
        radius, half_length, _ = self.humanoid.geom_size[geom]
        center = self.data.geom_xpos[geom] - origin
        if self.humanoid.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            shape = f'type="sphere" size="{radius}" pos="{attribute(center)}"'
        else:
            along = half_length * self.data.geom_xmat[geom].reshape(3, 3)[:, 2]
            shape = (
                f'type="capsule" size="{radius}" fromto="{attribute([*(center - along), *(center + along)])}"'
            )
        return f"{self._inertia([body], origin)}<geom {shape}/>"

    def _inertia(self, bodies: list[int], origin: Floats) -> str:
        """Return the inertia of `bodies` taken together in a frame at `origin`; only that about y matters."""
        masses, places = self.humanoid.body_mass[bodies], self.data.xipos[bodies]
        center = masses @ places / masses.sum()
        turns = self.data.ximat[bodies].reshape(-1, 3, 3)
        own = (turns[:, 1] ** 2 * self.humanoid.body_inertia[bodies]).sum()
        about_y = own + masses @ ((places - center)[:, [0, 2]] ** 2).sum(axis=1)
        where = f'pos="{attribute(center - origin)}" mass="{float(masses.sum())!r}"'
        return f'<inertial {where} diaginertia="{attribute([about_y] * 3)}"/>'


@cache
def _leg_offsets() -> tuple[tuple[float, float], ...]:
    """Return x and z from torso to hip, hip to knee and knee to foot of a stretched leg."""
    humanoid = humanoid_model()
    data = mujoco.MjData(humanoid)
    mujoco.mj_forward(humanoid, data)
    joints = [data.xanchor[1 + JOINTS.index(name)] for name in ("left_hip_y", "left_knee")]
    places = [data.body("torso").xpos, *joints, data.geom(FEET[0]).xpos]
    return tuple((float(x), float(z)) for x, _, z in np.diff(places, axis=0))


def sole_clearance(pose: Tensor) -> Tensor:
    """Return the heights of the left and the right sole above the floor, (..., 2) in m.

    `pose` (..., 6): height in m and pitch of the torso, left hip, left knee, right hip, right knee in rad.
    """
    height, pitch, hip, knee = pose[..., :1], pose[..., 1:2], pose[..., [2, 4]], pose[..., [3, 5]]
    for (x, z), angle in zip(_leg_offsets(), (pitch, pitch + hip, pitch + hip - knee), strict=True):
        height = height - x * torch.sin(angle) + z * torch.cos(angle)
    return height - FOOT_RADIUS_M


_JOINTS = ("left_hip", "left_knee", "right_hip", "right_knee")
_POSE = slice(0, 6)
_MOTION = slice(0, 13)
_CONTACTS = slice(13, 15)


class HumanoidWalker2d(FreeStates):
    """B walkers; action: angles of left hip, left knee, right hip, right knee, (B, 4), clipped to ±1.

    Attributes:
        state: (B, 15) float32, as `humanoid_to_walker2d` makes it.
        memory: depth of the floors below 0 in m, (B, 1) float64.
    """

    action_size = 4
    abstract_state = Column(
        ABSTRACT_STATE,
        size=15,
        names=(
            *("z", "pitch", *_JOINTS),
            *("vx", "vz", "pitch_rate", *(f"{name}_rate" for name in _JOINTS)),
            *("left_contact", "right_contact"),
        ),
        meaning="torso, legs and foot contacts of a planar walker",
        astra={
            "unit": ["m", *["rad"] * 5, "m/s", "m/s", *["rad/s"] * 5, "1", "1"],
            "frame": ["heading"] * 2 + ["joint"] * 4 + ["heading"] * 3 + ["joint"] * 4 + ["world"] * 2,
            "role": ["invariant"] * 15,
        },
    )
    abstraction = staticmethod(humanoid_to_walker2d)

    def __init__(self, num_envs: int, *, num_threads: int | None = None, device: str = "cpu") -> None:
        standing = humanoid_to_walker2d(torch.tensor(STANDING))
        super().__init__(standing.repeat(num_envs, 1).to(device))
        self.memory = self._sunk(self.state)
        self.ranges = CommandRanges()
        self._model = walker_model()
        self._models = [self._model]
        self._steps = ColdSteps(self._model, num_envs, num_threads)

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {"timestep_s": TIMESTEP_S, **self.ranges.parameters}

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use other joints and control steps from the next step on.

        Args:
            parameters: (B, 1) each: "friction", a factor on the damping of the joints; "timestep_scale", a
                factor on the control step, which keeps its number of physics steps. At 5/3 the longer physics
                steps put poses off by 0.3 % and rates by 1.2 % of what they change by in a step.
        """
        plain = self._model
        if self._models[0] is plain:
            self._models = [copy(plain) for _ in self.state]
        friction, timestep_scale = (
            parameters[name][:, 0].tolist() for name in ("friction", "timestep_scale")
        )
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
        landed = self._steps(self._models, placed, targets, substeps=CONTROL_SUBSTEPS)
        motion = torch.from_numpy(landed[:, 1:].copy())
        contacts = (sole_clearance(motion[:, _POSE]) < CONTACT_M).to(motion.dtype)
        motion[:, 0] -= sunk
        self.state = torch.cat([motion, contacts], dim=-1).float().to(self.state.device)
        return self.state
