"""Forward kinematics of the humanoid: center of mass and feet, for batches of joint angles.

Everything is in the torso's frame, in m.
"""

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
import torch
from torch import Tensor

from astra_data.robots.humanoid.model import FEET, JOINTS, humanoid_model

_TORSO = 1


@dataclass(frozen=True)
class _Link:
    """A body below the torso, as the model describes it.

    Attributes:
        parent: number of the parent body.
        offset: from the parent's origin to its own, (3,). turn: from its axes to the parent's, (3, 3).
        joints: their numbers among all 17. anchors: a point on each joint's axis, (3,).
    """

    parent: int
    offset: Tensor
    turn: Tensor
    joints: tuple[int, ...]
    anchors: tuple[Tensor, ...]


@dataclass(frozen=True)
class _Skeleton:
    """All bodies, in an order in which parents come first.

    Attributes:
        links: by the body's number.
        axes: of the joints in their bodies, (17, 3). crosses: matrices K with K v = axis x v, (17, 3, 3).
        centers: of mass of each of the 13 bodies in its own frame, (3,) by its number.
        shares: of the bodies in the total mass, (13,). moved: the shares that each joint moves, (17, 13).
        feet: number of the body that each foot belongs to, and the foot's center, (3,).
    """

    links: dict[int, _Link]
    axes: Tensor
    crosses: Tensor
    centers: dict[int, Tensor]
    shares: Tensor
    moved: Tensor
    feet: tuple[tuple[int, Tensor], ...]


@cache
def _skeleton(dtype: torch.dtype, device: torch.device) -> _Skeleton:
    model = humanoid_model()
    bodies = range(_TORSO, model.nbody)

    def tensor(values: object) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=dtype, device=device)

    links = {}
    moved = np.zeros((len(JOINTS), len(bodies)))
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
        feet=tuple((int(foot.bodyid[0]), tensor(foot.pos)) for foot in map(model.geom, FEET)),
    )


@dataclass(frozen=True)
class _Placed:
    """Positions of the parts of a humanoid.

    Attributes:
        mass: center of mass, (..., 3). centers: those of the bodies, (..., 13, 3). feet: (..., 2, 3).
        axes: of the joints, (..., 17, 3). anchors: points on them, (..., 17, 3).
    """

    mass: Tensor
    centers: Tensor
    feet: Tensor
    axes: Tensor
    anchors: Tensor


def _place(joints: Tensor) -> _Placed:
    skeleton = _skeleton(joints.dtype, joints.device)
    identity = torch.eye(3, dtype=joints.dtype, device=joints.device)
    angle = joints[..., None, None]
    crosses = skeleton.crosses
    turns = identity + torch.sin(angle) * crosses + (1 - torch.cos(angle)) * (crosses @ crosses)
    origin = torch.zeros(*joints.shape[:-1], 3, dtype=joints.dtype, device=joints.device)
    frames = {_TORSO: (origin, identity.expand(*joints.shape[:-1], 3, 3))}
    axes, anchors = [origin] * len(JOINTS), [origin] * len(JOINTS)
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
    return _Placed(
        mass=skeleton.shares @ centers,
        centers=centers,
        feet=torch.stack([place(body, center) for body, center in skeleton.feet], dim=-2),
        axes=torch.stack(axes, dim=-2),
        anchors=torch.stack(anchors, dim=-2),
    )


def mass_and_feet(joints: Tensor) -> tuple[Tensor, Tensor]:
    """Return the center of mass (..., 3), and the centers of the left and the right foot (..., 2, 3).

    `joints` (..., 17) are angles in rad, in the order of the state.
    """
    placed = _place(joints)
    return placed.mass, placed.feet


def mass_velocity(joints: Tensor, rates: Tensor) -> Tensor:
    """Return the velocity (..., 3) in m/s of the center of mass relative to the torso.

    `joints` (..., 17) are angles in rad, `rates` (..., 17) their rates in rad/s.
    """
    placed, skeleton = _place(joints), _skeleton(joints.dtype, joints.device)
    lever = skeleton.moved @ placed.centers - skeleton.moved.sum(-1, keepdim=True) * placed.anchors
    velocity: Tensor = (rates.unsqueeze(-1) * torch.linalg.cross(placed.axes, lever)).sum(-2)
    return velocity
