"""The interface of models that predict a walk step by step; the raw simulator, and one gain per axis.

All models have the same inputs: past motions in the body's frame, past actions, the ball in the body's frame,
and the abstract simulator's next motion. Predictions are therefore invariant to position and heading.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from astra_data.studies.motion import chained
from astra_data.studies.walks import Stretch

HALF_SEEN_M = 0.5


def bounded(ball: Tensor) -> Tensor:
    """Return the position of the ball, (..., 2) in m, as a vector (..., 2) within the unit circle.

    Its length is d / (d + `HALF_SEEN_M`): sensitive to distances d near the feet, flat far away.
    """
    distance: Tensor = ball.norm(dim=-1, keepdim=True)
    return ball / (distance + HALF_SEEN_M)


class Predictor(nn.Module, ABC):
    """Predicts the motion of each step; its memory (B, M) is passed in and returned."""

    @abstractmethod
    def begin(self, stretch: Stretch) -> Tensor:
        """Return the memory (B, M) of the stretches' history."""

    @abstractmethod
    def motion(self, memory: Tensor, ball: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the motion (B, 3) of the next step.

        Args:
            memory: of the history so far, (B, M).
            ball: in the body's frame, (B, 2) in m.
            action: of the step, (B, 4).
            simulated: the abstract simulator's motion, (B, 3).
        """

    @abstractmethod
    def after(self, memory: Tensor, motion: Tensor, ball: Tensor, action: Tensor) -> Tensor:
        """Return the memory (B, M) after a step of `motion` (B, 3) and `action` (B, 4) to `ball` (B, 2)."""


class Gains(Predictor):
    """The simulator with one constant gain per axis: system identification with three parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("gains", torch.ones(3))
        self.gains: Tensor

    def fit(self, stretch: Stretch) -> None:
        """Fit the gains by least squares to the end of each stretch, in closed form: first the turn."""
        end = chained(stretch.motion)[:, -1]
        turn = stretch.simulated[..., 2].sum(1)
        self.gains[2] = (turn @ end[:, 2]) / (turn @ turn)
        # Given the turn, the position is linear in the other two gains.
        parts = [
            chained(stretch.simulated * stretch.simulated.new_tensor([*axis, self.gains[2]]))[:, -1, :2]
            for axis in ((1.0, 0.0), (0.0, 1.0))
        ]
        places = torch.stack([part.flatten() for part in parts], dim=1)
        self.gains[:2] = torch.linalg.lstsq(places, end[:, :2].reshape(-1, 1)).solution[:, 0]

    def begin(self, stretch: Stretch) -> Tensor:
        """Return an empty memory, (B, 0)."""
        return stretch.motion.new_zeros(len(stretch), 0)

    def motion(self, memory: Tensor, ball: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the simulator's motion times the gains; before fitting they are 1: the raw simulator."""
        return simulated * self.gains

    def after(self, memory: Tensor, motion: Tensor, ball: Tensor, action: Tensor) -> Tensor:
        """Return the empty memory."""
        return memory
