"""Planar motions (..., 3): forward and left in m, turn in rad, in the frame of the body before it moves."""

import torch
from torch import Tensor

from astra_data.worlds.geometry import turned, wrapped

MIRROR = (1.0, -1.0, -1.0)
"""Signs of forward, left and turn in the mirror image."""


def between(before: Tensor, after: Tensor) -> Tensor:
    """Return the motion (..., 3) from one pose [x, y, heading] to another, both (..., 3)."""
    moved = turned(after[..., :2] - before[..., :2], -before[..., 2])
    return torch.cat([moved, wrapped(after[..., 2:] - before[..., 2:])], dim=-1)


def composed(first: Tensor, then: Tensor) -> Tensor:
    """Return the motion (..., 3) of `first` followed by `then`; `first` may be a pose."""
    place = first[..., :2] + turned(then[..., :2], first[..., 2])
    return torch.cat([place, first[..., 2:] + then[..., 2:]], dim=-1)


def chained(motions: Tensor) -> Tensor:
    """Return the cumulative motions (B, T, 3) after 1, 2, ... T of `motions` (B, T, 3)."""
    heading = torch.cat([torch.zeros_like(motions[:, :1, 2]), motions[..., 2].cumsum(1)], dim=1)
    place = turned(motions[..., :2], heading[:, :-1]).cumsum(1)
    return torch.cat([place, heading[:, 1:, None]], dim=-1)


def seen_after(point: Tensor, motion: Tensor) -> Tensor:
    """Return a resting `point` (..., 2), given in the body's frame, in its frame after `motion` (..., 3)."""
    return turned(point - motion[..., :2], -motion[..., 2])
