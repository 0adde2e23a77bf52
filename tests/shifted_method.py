"""Methods of a user's own whose correction is known: each step ends a little further along the first axis."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from astra_data.grounding.fit import Fitting
from astra_data.grounding.simulator import EpisodeSimulator, FittedGrounding, PlacedSimulator
from astra_data.methods.method import Method

SHIFT_M = 0.01


class ShiftedSimulator(EpisodeSimulator):
    """Adds a shift (X,) to each step."""

    def __init__(self, simulator: PlacedSimulator, shift: Tensor) -> None:
        super().__init__(simulator)
        self.shift = shift

    def step(self, action: Tensor) -> Tensor:
        before = self.state
        return self._settle(before, self.simulator.step(action) + self.shift)


@dataclass(frozen=True)
class Shifted(FittedGrounding):
    """Adds a shift (X,) to each step."""

    kind = "shifted"
    shift: Tensor

    def corrected(self, simulator: PlacedSimulator) -> EpisodeSimulator:
        return ShiftedSimulator(simulator, self.shift)

    def to_file(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        return {"shift": self.shift}, {}

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        return cls(tensors["shift"].to(device))


class Lossy(Shifted):
    """The same, but its file has lost the shift."""

    kind = "shifted, lossy"

    def to_file(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        return {"shift": torch.zeros_like(self.shift)}, {}


def shift_of(fitting: Fitting) -> Tensor:
    """Return the shift (X,)."""
    shift = torch.zeros(fitting.training.windows.state.shape[-1])
    shift[0] = SHIFT_M
    return shift


METHOD = Method(
    name="shifted", title="Shifted", fit=lambda fitting: (Shifted(shift_of(fitting)), {}), grounding=Shifted
)
LOSSY = Method(name="lossy", title="Lossy", fit=lambda fitting: (Lossy(shift_of(fitting)), {}), grounding=Lossy)
CLASHING = replace(METHOD, fit=lambda fitting: (Shifted(shift_of(fitting)), {"failures": 3, "machine": ""}))
WRONG: dict[Any, Any] = {"loss": torch.zeros(()), "r2": [1.0, math.nan], 2: 0.1}
UNWRITABLE = replace(METHOD, fit=lambda fitting: (Shifted(shift_of(fitting)), WRONG))
