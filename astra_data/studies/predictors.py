"""What predicts a walk, step by step; the raw simulator, and one constant gain per axis.

All see the same: the past motions in the body's frame, the past actions, the ball as the body sees it, and
what the abstract simulator does next. A turn or a shift of the field therefore changes none of their
predictions.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from astra_data.studies.motion import chained
from astra_data.studies.walks import Stretch

HALF_SEEN_M = 0.5


def bounded(ball: Tensor) -> Tensor:
    """Return where the ball is, (..., 2) in m, as a vector (..., 2) within the unit circle.

    Half as long as a ball `HALF_SEEN_M` away: near the feet every centimetre matters, far away none.
    """
    distance: Tensor = ball.norm(dim=-1, keepdim=True)
    return ball / (distance + HALF_SEEN_M)


class Predictor(nn.Module, ABC):
    """Predicts the motion of each step; what it remembers is handed in and out, (B, M)."""

    @abstractmethod
    def begin(self, stretch: Stretch) -> Tensor:
        """Return the memory (B, M) of the stretches' history."""

    @abstractmethod
    def motion(self, memory: Tensor, ball: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the motion (B, 3) of the next step.

        Args:
            memory: of the history so far, (B, M).
            ball: as the body sees it, (B, 2) in m.
            action: of the step, (B, 4).
            simulated: the abstract simulator's motion, (B, 3).
        """

    @abstractmethod
    def after(self, memory: Tensor, motion: Tensor, ball: Tensor, action: Tensor) -> Tensor:
        """Return the memory (B, M) after a step of `motion` (B, 3) under `action`, the ball now at `ball`."""


class Gains(Predictor):
    """The simulator with a constant gain on each axis's speed: system identification by three numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("gains", torch.ones(3))
        self.gains: Tensor

    def fit(self, stretch: Stretch) -> None:
        """Take the gains with the least squared error at the end of walked stretches; exact, turn first."""
        end = chained(stretch.motion)[:, -1]
        turn = stretch.simulated[..., 2].sum(1)
        self.gains[2] = (turn @ end[:, 2]) / (turn @ turn)
        # Once it is known how the body turns, its place is linear in the other two gains.
        parts = [
            chained(stretch.simulated * stretch.simulated.new_tensor([*axis, self.gains[2]]))[:, -1, :2]
            for axis in ((1.0, 0.0), (0.0, 1.0))
        ]
        places = torch.stack([part.flatten() for part in parts], dim=1)
        self.gains[:2] = torch.linalg.lstsq(places, end[:, :2].reshape(-1, 1)).solution[:, 0]

    def begin(self, stretch: Stretch) -> Tensor:
        """Remember nothing, (B, 0)."""
        return stretch.motion.new_zeros(len(stretch), 0)

    def motion(self, memory: Tensor, ball: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the simulator's motion times the gains; unfitted ones are 1: the raw simulator."""
        return simulated * self.gains

    def after(self, memory: Tensor, motion: Tensor, ball: Tensor, action: Tensor) -> Tensor:
        """Go on remembering nothing."""
        return memory
