"""A simulator as a user would write one: the target's planar position, moved by the command."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from astra_data.dataset.columns import Array, Column


class Glider:
    """B points [x, y] that move by 0.05 s times the commanded velocity, through walls and all."""

    abstract_state = Column("abstract.state", size=2, names=("x", "y"))
    parameters = {"timestep_s": 0.05}  # noqa: RUF012 - a constant

    def __init__(self, num_envs: int) -> None:
        self.state = torch.zeros(num_envs, 2)

    @staticmethod
    def abstraction(state: Array) -> Array:
        return state[:, :2]

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)

    def step(self, action: Tensor) -> Tensor:
        self.state = self.state + 0.05 * action
        return self.state


class Forgetful(Glider):
    """Resets to somewhere else."""

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        super().reset_to(0.9 * state, rows)


class Exploding(Glider):
    def step(self, action: Tensor) -> Tensor:
        return super().step(action) / 0.0


class Greedy(Glider):
    """Wants more of the state than there is."""

    @staticmethod
    def abstraction(state: Array) -> Array:
        return state[:, [0, 99]]


class Wide(Glider):
    @staticmethod
    def abstraction(state: Array) -> Array:
        return state[:, :3]


class Clumsy(Glider):
    def __init__(self) -> None:
        super().__init__(1)


class Narrow(Glider):
    def __init__(self, num_envs: int) -> None:
        self.state = torch.zeros(num_envs, 1)


class Bare(Glider):
    parameters = {"maze": None}  # type: ignore[dict-item] # noqa: RUF012


class Squeezing(Glider):
    def step(self, action: Tensor) -> Tensor:
        return super().step(action)[:, :1]


class Numeric(Glider):
    """Has its states as NumPy arrays."""

    def __init__(self, num_envs: int) -> None:
        self.state = np.zeros((num_envs, 2), np.float32)  # type: ignore[assignment]


class Relapsing(Glider):
    """Has them so once it is reset."""

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        self.state = state.numpy()  # type: ignore[assignment]


@dataclass
class Settings:
    """Dataclasses look for their module."""

    timestep_s: float = 0.05
