"""A policy of another learner, as short as one can be."""

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from astra_data.dataset.columns import Array


class Constant:
    """Always the same command."""

    kind: ClassVar[str] = "constant"

    def __init__(self, command: float) -> None:
        self.command = command

    def act(self, observation: Array) -> Array:
        return np.full((len(observation), 1), self.command)

    def to_file(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        return {"command": torch.tensor([self.command])}, {"unit": "none"}

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any]) -> Self:
        assert metadata == {"unit": "none"}
        return cls(float(tensors["command"]))
