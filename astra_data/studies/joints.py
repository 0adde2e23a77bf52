"""Joints that are sent to targets, and their abstract simulator: a first-order response."""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.core.config import Config, NotNegative, Positive
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, STATE
from astra_data.dataset.reader import Dataset
from astra_data.studies.body import Body

ALL = "all_joints"
"""The axis whose squared error is the mean over all joints."""


@dataclass(frozen=True)
class Joints(Body):
    """J joints: positions are seen, their changes are motions, and commands are how far the target is away.

    In a step the abstract simulator covers the share 1 - exp(-step_s / time_constant_s) of the way to the
    target, all of it where the time constant is 0. Without recorded targets it stands still.

    Attributes:
        time_constant_s: of the simulator. step_s: length of a control step.
    """

    time_constant_s: float = 0.0
    step_s: float = 0.0

    @classmethod
    def named(cls, names: tuple[str, ...], *, has_targets: bool, time_constant_s: float = 0.0) -> Self:
        """Return the joints `names`."""
        size = len(names)
        return cls(
            motion_size=size,
            given_size=size if has_targets else 0,
            seen_size=size,
            axes=(ALL, *names),
            judged=(ALL,),
            usual_motion=(1.0,) * size,
            usual_seen=(1.0,) * size,
            is_scaled=True,
            # Less than 0.1 degrees: positions come from encoders.
            noise=((1e-3,) * size, (1e-3,) * size),
            time_constant_s=time_constant_s,
        )

    def at(self, step_s: float) -> Self:
        """Return the joints whose control step takes `step_s`."""
        return replace(self, step_s=step_s)

    @property
    def share(self) -> float:
        """Share of the way to the target that the simulator covers in a step."""
        return 1.0 if self.time_constant_s == 0 else 1 - math.exp(-self.step_s / self.time_constant_s)

    def steps(self, state: Floats, action: Floats, rows: int, fps: int) -> dict[str, Tensor]:
        """Take the mean target of each step; see `Body.steps`."""
        seen = torch.from_numpy(state[::rows])
        steps = len(seen) - 1
        targets = torch.from_numpy(action).reshape(steps, rows, action.shape[1]).mean(1)
        motion = seen.diff(dim=0)
        return {
            "motion": motion.float(),
            "simulated": self.command(targets, torch.zeros_like(motion), seen[:-1])[1].float(),
            "action": targets.float(),
            "seen": seen.float(),
            "heading": torch.zeros(len(motion)),
        }

    def chained(self, motions: Tensor) -> Tensor:
        """Return the sums."""
        return motions.cumsum(1)

    def composed(self, first: Tensor, then: Tensor) -> Tensor:
        """Return the sum."""
        return first + then

    def seen_after(self, seen: Tensor, motion: Tensor) -> Tensor:
        """Return the positions after the motion."""
        return seen + motion

    def features(self, seen: Tensor) -> Tensor:
        """Return the positions."""
        return seen

    def command(self, action: Tensor, simulated: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return how far the targets are from the positions `seen`, and the response to that."""
        if self.given_size == 0:
            return action, torch.zeros_like(seen)
        away = action - seen
        return away, self.share * away

    def nearer(self, seen: Tensor, given: Tensor, motion: Tensor) -> Tensor:
        """Return how much nearer the joints come to their targets, the mean over them; 0 without targets."""
        if self.given_size == 0:
            return motion.new_zeros(motion.shape[0], motion.shape[1] - 1)
        return (given.abs() - (given - motion).abs())[:, 1:].mean(-1)

    def wrong(self, predicted: Tensor, true: Tensor, heading: Tensor) -> Tensor:
        """Return the root of the mean square over the joints, and the error of each."""
        wrong = predicted - true
        return torch.cat([wrong.square().mean(-1, keepdim=True).sqrt(), wrong], dim=-1)


class JointsConfig(Config):
    """How the joints' simulator responds, and how recordings of joints are cut."""

    time_constant_s: NotNegative = 0.0
    """Time constant of the simulator's first-order response to targets; 0 for joints that reach targets at
    once."""
    piece_s: Positive = 30.0
    """Longer episodes are cut into pieces of this length, the unit of hold-out and resampling."""

    def body(self, dataset: Dataset) -> Body:
        """Return the joints of observation.state; those of action are their targets, in the same order.

        Raises:
            BadInputError: there is no observation.state; or there are targets, but not one for each joint.
        """
        found = {column.name: column for column in dataset.schema}
        if STATE not in found:
            raise BadInputError(
                f"{dataset.reference}: expected joints in observation.state, found no such column"
            )
        state, action = found[STATE], found.get(ACTION)
        if action is not None and action.size != state.size:
            raise BadInputError(
                f"{dataset.reference}: action holds {action.size} values, expected a target for each of the "
                f"{state.size} joints of observation.state, or no column action"
            )
        names = state.names or tuple(f"joint_{number}" for number in range(1, state.size + 1))
        return Joints.named(names, has_targets=action is not None, time_constant_s=self.time_constant_s)

    def broken(self, state: Floats, fps: int) -> NDArray[np.bool_]:
        """Return False for all rows: encoders do not jump."""
        return np.zeros(len(state) - 1, bool)
