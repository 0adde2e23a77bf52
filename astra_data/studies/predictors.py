"""The interface of models that predict step by step; the raw simulator, and what is identified of it.

All models have the same inputs: past motions, past commands, what is seen, and the abstract simulator's next
motion. Of a walk all are in the body's frame, so predictions are invariant to position and heading.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from astra_data.studies.motion import chained
from astra_data.studies.sequences import Stretch

LEAST_DEVIATION = 1e-6
"""Least deviation that inputs and corrections are divided by."""


class Predictor(nn.Module, ABC):
    """Predicts the motion of each step; its memory (B, N) is passed in and returned."""

    @abstractmethod
    def begin(self, stretch: Stretch) -> Tensor:
        """Return the memory (B, N) of the stretches' history."""

    @abstractmethod
    def motion(self, memory: Tensor, seen: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the motion (B, M) of the next step.

        Args:
            memory: of the history so far, (B, N).
            seen: before the step, (B, S): of a walk the ball in the body's frame, of joints their positions.
            action: the command of the step, (B, G).
            simulated: the abstract simulator's motion, (B, M).
        """

    @abstractmethod
    def after(self, memory: Tensor, motion: Tensor, seen: Tensor, action: Tensor) -> Tensor:
        """Return the memory (B, N) after a step of `motion` (B, M) and `action` (B, G) to `seen` (B, S)."""


class Gains(Predictor):
    """The simulator with one constant gain per axis of a walk: three parameters are identified."""

    def __init__(self, size: int = 3) -> None:
        super().__init__()
        self.register_buffer("gains", torch.ones(size))
        self.gains: Tensor

    def fit(self, stretch: Stretch) -> None:
        """Fit the gains by least squares to the end of each stretch, in closed form: first the turn."""
        end = chained(stretch.motion)[:, -1]
        turn = stretch.simulated[..., 2].sum(1)
        if turn.any():
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

    def motion(self, memory: Tensor, seen: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the simulator's motion times the gains; before fitting they are 1: the raw simulator."""
        return simulated * self.gains

    def after(self, memory: Tensor, motion: Tensor, seen: Tensor, action: Tensor) -> Tensor:
        """Return the empty memory."""
        return memory


class Response(Predictor):
    """Joints with a second-order response each: three parameters per joint are identified.

    The motion of a step is a times how far the target is away, plus b times the motion of the step before,
    plus c: a spring, what is left after damping, and a constant pull such as gravity's.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("weights", torch.zeros(size, 3))
        self.weights: Tensor

    def fit(self, stretch: Stretch) -> None:
        """Fit the three of each joint by least squares to the first step of each stretch."""
        _, away, _ = stretch.first()
        inputs = self._inputs(stretch.past_motion[:, -1], away).double()
        target = stretch.motion[:, 0].double()
        for joint, weights in enumerate(self.weights):
            solution = torch.linalg.lstsq(inputs[:, joint], target[:, joint, None], driver="gelsd").solution
            weights.copy_(solution[:, 0])

    def begin(self, stretch: Stretch) -> Tensor:
        """Return the last motion, (B, M)."""
        return stretch.past_motion[:, -1]

    def motion(self, memory: Tensor, seen: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the response to how far the targets are away, `action` (B, M), or (B, 0) without targets."""
        return (self._inputs(memory, action) * self.weights).sum(-1)

    def after(self, memory: Tensor, motion: Tensor, seen: Tensor, action: Tensor) -> Tensor:
        """Return the motion."""
        return motion

    @staticmethod
    def _inputs(before: Tensor, away: Tensor) -> Tensor:
        """Return what the weights stand at, (B, M, 3)."""
        pull = away if away.shape[-1] else torch.zeros_like(before)
        return torch.stack([pull, before, torch.ones_like(before)], dim=-1)
