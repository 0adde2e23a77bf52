"""Behaviours: what acts in the target while data is collected."""

from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from astra_data.deployment import DeployedPolicy
from astra_data.seeding import derive, generator


class Behavior(Protocol):
    """Acts on B robots."""

    def start(self, count: int, seed: int) -> None:
        """Begin new episodes of B = `count` robots; `seed` decides everything random."""
        ...

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A) for target states (B, S) and goals (B, G)."""
        ...


class RandomCommands:
    """Commands from U[-1, 1]² m/s, each held for a random number of steps."""

    def __init__(self, hold_steps: tuple[int, int]) -> None:
        """Take the fewest and the most steps for which a command is held."""
        self._hold_steps = hold_steps

    def start(self, count: int, seed: int) -> None:
        """Begin new episodes of B = `count` robots."""
        self._rng = generator(seed, "behavior")
        self._command = np.zeros((count, 2))
        self._left = np.zeros(count, dtype=int)

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return commands (B, 2) in m/s; neither state nor goal matters."""
        due = np.flatnonzero(self._left == 0)
        fewest, most = self._hold_steps
        self._command[due] = self._rng.uniform(-1.0, 1.0, (len(due), 2))
        self._left[due] = self._rng.integers(fewest, most + 1, len(due))
        self._left -= 1
        return torch.from_numpy(self._command).float()


class PolicyBehavior:
    """A policy that draws its actions from its distribution, as it does in training."""

    def __init__(self, deployed: DeployedPolicy) -> None:
        self._deployed = deployed

    def start(self, count: int, seed: int) -> None:
        """Begin new episodes of B = `count` robots."""
        self._deployed.start(count, torch.Generator().manual_seed(derive(seed, "behavior")))

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A) for target states (B, S) and goals (B, G)."""
        return self._deployed.act(state, goal)
