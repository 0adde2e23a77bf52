"""φ of the humanoid, one function per abstract simulator, from target states (..., 47).

numpy in, numpy out, torch in, torch out. All of them drop the position on the floor, which the dynamics do
not depend on.
"""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from astra_data.core.arrays import normalized
from astra_data.robots.humanoid.model import COMMANDED, CONTACT_M, FOOT_RADIUS_M, JOINTS, POSITIONS
from astra_data.robots.humanoid.skeleton import mass_and_feet, mass_velocity
from astra_data.robots.humanoid.spread import VELOCITY_M_S, in_spreads
from astra_data.worlds.rotation import rotation

_HEIGHT = 2
_QUATERNION = slice(3, 7)
_JOINTS = slice(7, POSITIONS)
_VELOCITY = slice(POSITIONS, POSITIONS + 3)
_SPIN = slice(POSITIONS + 3, POSITIONS + 6)
_RATES = slice(POSITIONS + 6, None)


def humanoid_to_walker2d[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep the state of a planar walker: (..., 47) to (..., 15).

    Height in m and pitch in rad of the torso, the angles of left hip, left knee, right hip, right knee; the
    torso's horizontal velocity along its heading in m/s, then the velocities of all of these; and whether
    left and right foot touch the floor, 1 or 0. The pitch is the angle of the torso's forward axis below the
    horizon. Dropped: the velocity to the side, the heading, roll and turning of the torso, and the joints
    that no command moves, though the feet's heights depend on those too.
    """
    return _mapped(_walker2d, state)


def humanoid_to_kinematics[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](state: Array) -> Array:
    """Keep the angles in rad and rates in rad/s of all joints: (..., 47) to (..., 34).

    Dropped: position, orientation and velocity of the body.
    """
    return _mapped(_kinematics, state)


def humanoid_to_extended_kinematics[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](
    state: Array,
) -> Array:
    """Keep all joints, the motion of the center of mass and the lean of the torso: (..., 47) to (..., 46).

    After the joints (34): x and y of the center of mass relative to the midpoint of the feet, and its height
    above the floor, in m; its velocity (3) in m/s. These are in a level frame whose x axis is the torso's
    heading, so that steps look the same in all directions. The center of mass of a falling humanoid first
    leaves the area above the feet, then drops. Then, in the torso's frame, the direction of up (3) and the
    torso's angular velocity (3) in rad/s: what the paper calls robot-level information, citing a robot that
    observes both (Radosavovic et al. 2024). Dropped: the heading.
    """
    return _mapped(_extended_kinematics, state)


def beyond_walker2d(state: Tensor) -> Tensor:
    """Return the part that `humanoid_to_walker2d` drops: (..., 47) to (..., 34), in spreads.

    The torso's orientation and angular velocity, its velocity to the left, and the joints that no command
    moves.
    """
    seen = in_spreads(state)
    velocity = _headed(rotation(state[..., _QUATERNION]), state[..., _VELOCITY])
    rest = [joint for joint in range(len(JOINTS)) if joint not in COMMANDED]
    joints, rates = seen[..., _JOINTS][..., rest], seen[..., _RATES][..., rest]
    left = normalized(velocity[..., 1:2], 0.0, VELOCITY_M_S)
    return torch.cat([seen[..., _QUATERNION], joints, left, seen[..., _SPIN], rates], dim=-1)


def beyond_kinematics(state: Tensor) -> Tensor:
    """Return what `humanoid_to_kinematics` drops except x and y: (..., 47) to (..., 11), in spreads."""
    seen = in_spreads(state)
    height, quaternion = seen[..., [_HEIGHT]], seen[..., _QUATERNION]
    return torch.cat([height, quaternion, seen[..., _VELOCITY], seen[..., _SPIN]], dim=-1)


def beyond_extended_kinematics(state: Tensor) -> Tensor:
    """Return what `humanoid_to_extended_kinematics` drops except x and y: (..., 47) to (..., 2).

    The heading, as cosine and sine.
    """
    return _heading(rotation(state[..., _QUATERNION]))


def _mapped[Array: (NDArray[np.float32], NDArray[np.float64], Tensor)](
    abstraction: Callable[[Tensor], Tensor], state: Array
) -> Array:
    return abstraction(state) if isinstance(state, Tensor) else abstraction(torch.from_numpy(state)).numpy()


def _walker2d(state: Tensor) -> Tensor:
    height, spin = state[..., _HEIGHT], state[..., _SPIN]
    joints, turn = state[..., _JOINTS], rotation(state[..., _QUATERNION])
    velocity = _headed(turn, state[..., _VELOCITY])
    # The vertical components of the torso's axes.
    forward, left, up = turn[..., 2, :].unbind(-1)
    level = torch.hypot(left, up).clamp_min(1e-6)
    pitch = torch.atan2(-forward, level)
    pitch_rate = (up * spin[..., 1] - left * spin[..., 2]) / level
    _, feet = mass_and_feet(joints)
    axes = torch.stack([forward, left, up], dim=-1).unsqueeze(-2)
    clearance = height.unsqueeze(-1) + (axes * feet).sum(-1) - FOOT_RADIUS_M
    pose = [torch.stack([height, pitch], dim=-1), joints[..., COMMANDED]]
    rates = [velocity[..., [0, 2]], pitch_rate.unsqueeze(-1), state[..., _RATES][..., COMMANDED]]
    return torch.cat([*pose, *rates, (clearance < CONTACT_M).to(state.dtype)], dim=-1)


def _kinematics(state: Tensor) -> Tensor:
    return torch.cat([state[..., _JOINTS], state[..., _RATES]], dim=-1)


def _extended_kinematics(state: Tensor) -> Tensor:
    joints, rates = state[..., _JOINTS], state[..., _RATES]
    turn = rotation(state[..., _QUATERNION])

    def turned(vector: Tensor) -> Tensor:
        return (turn @ vector.unsqueeze(-1)).squeeze(-1)

    mass, feet = mass_and_feet(joints)
    aside = _headed(turn, turned(mass - feet.mean(-2)))[..., :2]
    height = state[..., _HEIGHT, None] + turned(mass)[..., 2:]
    spin = state[..., _SPIN]
    swept = torch.linalg.cross(spin, mass) + mass_velocity(joints, rates)
    velocity = _headed(turn, state[..., _VELOCITY] + turned(swept))
    return torch.cat([joints, rates, aside, height, velocity, turn[..., 2, :], spin], dim=-1)


def _heading(turn: Tensor) -> Tensor:
    """Return the headings of torsos with rotations (..., 3, 3), as cosine and sine (..., 2)."""
    return functional.normalize(turn[..., :2, 0], dim=-1)


def _headed(turn: Tensor, vector: Tensor) -> Tensor:
    """Return vectors (..., 3) in the level frames along the headings of torsos with rotations (..., 3, 3)."""
    cosine, sine = _heading(turn).unbind(-1)
    x, y, z = vector.unbind(-1)
    return torch.stack([cosine * x + sine * y, cosine * y - sine * x, z], dim=-1)
