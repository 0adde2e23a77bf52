"""The planar walker's MuJoCo model: the humanoid's legs under one link for the rest, in the plane of x and z.

Lengths, masses, joints and motors are read from the humanoid's model in its initial pose.
"""

from functools import cache

import mujoco
import numpy as np
import torch
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.robots.humanoid.model import (
    COMMANDED,
    DAMPING,
    FEET,
    FOOT_RADIUS_M,
    JOINTS,
    STIFFNESS,
    humanoid_model,
)
from astra_data.worlds.batched_mujoco import attribute

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
