"""A walking body in the plane, with a ball, and which rows of its recordings are walking."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.core.config import Config, Positive
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE
from astra_data.dataset.reader import Dataset
from astra_data.studies.body import Body
from astra_data.studies.motion import MIRROR, between, chained, composed, seen_after
from astra_data.studies.planar_walker import PlanarWalker
from astra_data.worlds.geometry import turned, wrapped

STATE_NAMES = ("x", "y", "yaw", "ball_x", "ball_y")
ACTION_NAMES = ("turn", "forward", "left", "kick")

AXES = ("forward_m", "left_m", "turn_rad", "field_x_m", "field_y_m")
"""Displacement and turn in the body's frame at the start; and the displacement in the field's frame."""

BODY_AXES = AXES[:3]
HALF_SEEN_M = 0.5


def bounded(ball: Tensor) -> Tensor:
    """Return the position of the ball, (..., 2) in m, as a vector (..., 2) within the unit circle.

    Its length is d / (d + `HALF_SEEN_M`): sensitive to distances d near the feet, flat far away.
    """
    distance: Tensor = ball.norm(dim=-1, keepdim=True)
    return ball / (distance + HALF_SEEN_M)


@dataclass(frozen=True)
class WalkingBody(Body):
    """A body that walks in the plane: `motion`s in its frame, commands of a policy, the ball in its frame."""

    def steps(self, state: Floats, action: Floats, rows: int, fps: int) -> dict[str, Tensor]:
        """Replay each step in the planar abstract simulator; see `Body.steps`."""
        states = torch.from_numpy(state[::rows])
        actions = torch.from_numpy(action).reshape(-1, rows, action.shape[1])
        pose = states[:, :3]
        return {
            "motion": between(pose[:-1], pose[1:]).float(),
            "simulated": _replayed(states[:-1], actions, fps).float(),
            "action": actions.mean(1).float(),
            "seen": turned(states[:, 3:] - pose[:, :2], -pose[:, 2]).float(),
            "heading": pose[:-1, 2].float(),
        }

    def chained(self, motions: Tensor) -> Tensor:
        """Return `motion.chained`."""
        return chained(motions)

    def composed(self, first: Tensor, then: Tensor) -> Tensor:
        """Return `motion.composed`."""
        return composed(first, then)

    def seen_after(self, seen: Tensor, motion: Tensor) -> Tensor:
        """Return the ball, which rests, in the frame after the motion."""
        return seen_after(seen, motion)

    def features(self, seen: Tensor) -> Tensor:
        """Return the bounded position of the ball."""
        return bounded(seen)

    def command(self, action: Tensor, simulated: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return both as they are: they do not depend on where the body is."""
        return action, simulated

    def nearer(self, seen: Tensor, given: Tensor, motion: Tensor) -> Tensor:
        """Return the decrease of the bounded distance of the ball."""
        distance: Tensor = bounded(seen).norm(dim=-1)
        return distance[:, :-1] - distance[:, 1:]

    def wrong(self, predicted: Tensor, true: Tensor, heading: Tensor) -> Tensor:
        """Return errors in the body's frame, and those of the place in the field's."""
        wrong = predicted - true
        field = turned(wrong[..., :2], heading[:, None].expand(wrong.shape[:2]))
        return torch.cat([wrong[..., :2], wrapped(wrong[..., 2:]), field], dim=-1)


WALKER = WalkingBody(
    motion_size=3,
    given_size=4,
    seen_size=2,
    axes=AXES,
    judged=BODY_AXES,
    mirror={"motion": MIRROR, "action": (-1.0, 1.0, -1.0, 1.0), "seen": (1.0, -1.0)},
    usual_motion=(1.0, 0.0, 0.0),
    usual_seen=(1.0, 0.0),
    noise=((0.02, 0.02, 0.06), (0.1, 0.1)),
)


def _replayed(state: Tensor, action: Tensor, fps: int) -> Tensor:
    """Return the abstract simulator's motions (T, 3) from `state` (T, 5) under actions (T, rows, 4)."""
    simulator = PlanarWalker(len(state), timestep_s=1 / fps)
    # The velocity before does not matter: the body follows commands at once.
    standing = torch.zeros(len(state), 3, dtype=state.dtype)
    simulator.reset_to(torch.cat([state[:, :3], standing, state[:, 3:]], dim=-1))
    for row in action.unbind(1):
        simulator.step(row)
    return between(state[:, :3], simulator.state[:, :3])


class WalkingConfig(Config):
    """When a robot counts as walking: not while it is carried, nor where self-localization jumps."""

    jump_m: Positive = 0.06
    """A larger displacement between two rows is a jump of self-localization: at 60 Hz, 3.6 m/s."""
    jump_rad: Positive = 0.1
    """The same for the change of heading."""
    fastest_m_s: Positive = 0.6
    """A robot that is faster than this over half a second is being carried or corrects its position. Twice
    the maximum speed of the robot's walk engine."""
    piece_s: Positive = 30.0
    """Longer episodes are cut into pieces of this length, the unit of hold-out and resampling."""

    def body(self, dataset: Dataset) -> Body:
        """Return the walking body.

        Raises:
            BadInputError: the dataset's columns are not those of the walk.
        """
        expected = {STATE: STATE_NAMES, NEXT_STATE: STATE_NAMES, ACTION: ACTION_NAMES}
        found = {column.name: column.names for column in dataset.schema}
        faults = [
            f"{name} holds {', '.join(found.get(name) or ('no names',))}, expected {', '.join(names)}"
            for name, names in expected.items()
            if found.get(name) != names
        ]
        if faults:
            raise BadInputError(f"{dataset.reference}: {'; '.join(faults)}")
        return WALKER

    def broken(self, state: Floats, fps: int) -> NDArray[np.bool_]:
        """Return which rows (N,) between states (N + 1, 5) are not walking: jumps, and too high speeds."""
        place, heading = state[:, :2], state[:, 2]
        moved = np.linalg.norm(np.diff(place, axis=0), axis=1)
        broken = (moved > self.jump_m) | (abs(wrapped(np.diff(heading))) > self.jump_rad)
        half = min(max(1, fps // 2), len(moved))
        far = np.linalg.norm(place[half:] - place[:-half], axis=1) > self.fastest_m_s * half / fps
        for first in np.flatnonzero(far):
            broken[first : first + half] = True
        return np.asarray(broken)
