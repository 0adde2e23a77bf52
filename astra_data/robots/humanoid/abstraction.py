"""φ of the humanoid for each abstract simulator, (..., 47) to (..., X), and the forward kinematics that it needs."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from astra_data.core.arrays import Floats, normalized
from astra_data.robots.humanoid import target as humanoid
from astra_data.worlds.geometry import rotation

_TORSO = 1


class _Link(NamedTuple):
    """A body below the torso, as the model describes it."""

    parent: int
    offset: Tensor  # from the parent's origin to its own, (3,)
    turn: Tensor  # from its axes to the parent's, (3, 3)
    joints: tuple[int, ...]  # among all 17
    anchors: tuple[Tensor, ...]  # a point on each joint's axis, (3,)


class _Skeleton(NamedTuple):
    """All bodies, in an order in which parents come first."""

    links: dict[int, _Link]  # by the body's number
    axes: Tensor  # of the joints in their bodies, (17, 3)
    crosses: Tensor  # matrices K with K v = axis x v, (17, 3, 3)
    centers: dict[int, Tensor]  # of mass of each of the 13 bodies in its own frame, (3,)
    shares: Tensor  # of the bodies in the total mass, (13,)
    moved: Tensor  # the shares that each joint moves, (17, 13)
    feet: tuple[tuple[int, Tensor], ...]  # body that each foot belongs to, and the foot's center, (3,)


@cache
def _skeleton(dtype: torch.dtype, device: torch.device) -> _Skeleton:
    model = humanoid.humanoid_model()
    bodies = range(_TORSO, model.nbody)

    def tensor(values: object) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=dtype, device=device)

    links = {}
    moved = np.zeros((len(humanoid.JOINTS), len(bodies)))
    shares = model.body_mass[bodies] / model.body_mass.sum()
    for body in bodies[1:]:
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_quat[body])
        first = model.body_jntadr[body]
        joints = range(first, first + model.body_jntnum[body])
        links[body] = _Link(
            parent=int(model.body_parentid[body]),
            offset=tensor(model.body_pos[body]),
            turn=tensor(turn.reshape(3, 3)),
            joints=tuple(joint - 1 for joint in joints),
            anchors=tuple(tensor(model.jnt_pos[joint]) for joint in joints),
        )
        carrier = body
        while carrier != _TORSO:
            moved[links[carrier].joints, body - _TORSO] = shares[body - _TORSO]
            carrier = links[carrier].parent
    axes = model.jnt_axis[1:]
    return _Skeleton(
        links=links,
        axes=tensor(axes),
        crosses=tensor([np.cross(np.eye(3), axis) for axis in axes]),
        centers={body: tensor(model.body_ipos[body]) for body in bodies},
        shares=tensor(shares),
        moved=tensor(moved),
        feet=tuple((int(foot.bodyid[0]), tensor(foot.pos)) for foot in map(model.geom, humanoid.FEET)),
    )


def _place(joints: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return centers of mass of the bodies (..., 13, 3), feet (..., 2, 3), joints' axes and anchors (..., 17, 3)."""
    skeleton = _skeleton(joints.dtype, joints.device)
    identity = torch.eye(3, dtype=joints.dtype, device=joints.device)
    angle = joints[..., None, None]
    crosses = skeleton.crosses
    turns = identity + torch.sin(angle) * crosses + (1 - torch.cos(angle)) * (crosses @ crosses)
    origin = torch.zeros(*joints.shape[:-1], 3, dtype=joints.dtype, device=joints.device)
    frames = {_TORSO: (origin, identity.expand(*joints.shape[:-1], 3, 3))}
    axes, anchors = [origin] * len(humanoid.JOINTS), [origin] * len(humanoid.JOINTS)
    for body, link in skeleton.links.items():
        origin, turn = frames[link.parent]
        origin = origin + turn @ link.offset
        turn = turn @ link.turn
        for joint, anchor in zip(link.joints, link.anchors, strict=True):
            axes[joint], anchors[joint] = turn @ skeleton.axes[joint], origin + turn @ anchor
            turn = turn @ turns[..., joint, :, :]
            origin = anchors[joint] - turn @ anchor
        frames[body] = origin, turn

    def place(body: int, point: Tensor) -> Tensor:
        origin, turn = frames[body]
        return origin + turn @ point

    centers = torch.stack([place(body, center) for body, center in skeleton.centers.items()], dim=-2)
    feet = torch.stack([place(body, center) for body, center in skeleton.feet], dim=-2)
    return centers, feet, torch.stack(axes, dim=-2), torch.stack(anchors, dim=-2)


def mass_and_feet(joints: Tensor) -> tuple[Tensor, Tensor]:
    """Return center of mass (..., 3), left and right foot (..., 2, 3) in the torso's frame, of angles (..., 17)."""
    centers, feet, _, _ = _place(joints)
    return _skeleton(joints.dtype, joints.device).shares @ centers, feet


def mass_velocity(joints: Tensor, rates: Tensor) -> Tensor:
    """Return the center of mass's velocity (..., 3) in m/s relative to the torso, of angles and rates (..., 17)."""
    centers, _, axes, anchors = _place(joints)
    moved = _skeleton(joints.dtype, joints.device).moved
    lever = moved @ centers - moved.sum(-1, keepdim=True) * anchors
    velocity: Tensor = (rates.unsqueeze(-1) * torch.linalg.cross(axes, lever)).sum(-2)
    return velocity


_HEIGHT = 2
_QUATERNION = slice(3, 7)
_JOINTS = slice(7, humanoid.POSITIONS)
_VELOCITY = slice(humanoid.POSITIONS, humanoid.POSITIONS + 3)
_SPIN = slice(humanoid.POSITIONS + 3, humanoid.POSITIONS + 6)
_RATES = slice(humanoid.POSITIONS + 6, None)


class Phi:
    """φ of tensors, which takes and returns arrays, too."""

    def __init__(self, of_tensors: Callable[[Tensor], Tensor]) -> None:
        self._of_tensors = of_tensors
        self.__name__, self.__doc__ = of_tensors.__name__, of_tensors.__doc__

    def __call__[Array: (NDArray[np.float32], Floats, Tensor)](self, state: Array) -> Array:
        """Return φ of states (..., 47)."""
        if isinstance(state, Tensor):
            return self._of_tensors(state)
        return self._of_tensors(torch.from_numpy(state)).numpy()

    def __reduce__(self) -> str:
        """Pickle it by its name, as functions are."""
        return self._of_tensors.__name__


@Phi
def humanoid_to_walker2d(state: Tensor) -> Tensor:
    """Keep a planar walker: height, pitch, hips and knees, their rates, contacts of feet: (..., 47) to (..., 15)."""
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
    clearance = height.unsqueeze(-1) + (axes * feet).sum(-1) - humanoid.FOOT_RADIUS_M
    pose = [torch.stack([height, pitch], dim=-1), joints[..., humanoid.COMMANDED]]
    rates = [velocity[..., [0, 2]], pitch_rate.unsqueeze(-1), state[..., _RATES][..., humanoid.COMMANDED]]
    return torch.cat([*pose, *rates, (clearance < humanoid.CONTACT_M).to(state.dtype)], dim=-1)


@Phi
def humanoid_to_kinematics(state: Tensor) -> Tensor:
    """Keep the angles in rad and rates in rad/s of all joints: (..., 47) to (..., 34)."""
    return torch.cat([state[..., _JOINTS], state[..., _RATES]], dim=-1)


@Phi
def humanoid_to_extended_kinematics(state: Tensor) -> Tensor:
    """Keep joints, center of mass along the heading, its velocity, the torso's up and spin: (..., 47) to (..., 46)."""
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


def beyond_walker2d(state: Tensor) -> Tensor:
    """Return what `humanoid_to_walker2d` drops except x and y: (..., 47) to (..., 34), in spreads."""
    seen = humanoid.in_spreads(state)
    velocity = _headed(rotation(state[..., _QUATERNION]), state[..., _VELOCITY])
    rest = [joint for joint in range(len(humanoid.JOINTS)) if joint not in humanoid.COMMANDED]
    joints, rates = seen[..., _JOINTS][..., rest], seen[..., _RATES][..., rest]
    left = normalized(velocity[..., 1:2], 0.0, humanoid.VELOCITY_M_S)
    return torch.cat([seen[..., _QUATERNION], joints, left, seen[..., _SPIN], rates], dim=-1)


def beyond_kinematics(state: Tensor) -> Tensor:
    """Return what `humanoid_to_kinematics` drops except x and y: (..., 47) to (..., 11), in spreads."""
    seen = humanoid.in_spreads(state)
    height, quaternion = seen[..., [_HEIGHT]], seen[..., _QUATERNION]
    return torch.cat([height, quaternion, seen[..., _VELOCITY], seen[..., _SPIN]], dim=-1)


def beyond_extended_kinematics(state: Tensor) -> Tensor:
    """Return the heading, which `humanoid_to_extended_kinematics` drops, as cosine and sine: (..., 47) to (..., 2)."""
    return _heading(rotation(state[..., _QUATERNION]))


def _heading(turn: Tensor) -> Tensor:
    """Return the headings of torsos with rotations (..., 3, 3), as cosine and sine (..., 2)."""
    return functional.normalize(turn[..., :2, 0], dim=-1)


def _headed(turn: Tensor, vector: Tensor) -> Tensor:
    """Return vectors (..., 3) in the level frames along the headings of torsos with rotations (..., 3, 3)."""
    cosine, sine = _heading(turn).unbind(-1)
    x, y, z = vector.unbind(-1)
    return torch.stack([cosine * x + sine * y, cosine * y - sine * x, z], dim=-1)
