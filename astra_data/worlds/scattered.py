"""A simulator with Gaussian noise of a given covariance on its state after every step."""

import torch
from torch import Tensor

from astra_data.worlds.protocols import PlacedSimulator


class RandomizedSimulator:
    """Steps a simulator, adds noise to its state, and settles it there.

    Attributes:
        state: (B, X). blocked: (B,) bool, the last step was stopped at the edge of the free space.
    """

    def __init__(self, simulator: PlacedSimulator, noise_factor: Tensor) -> None:
        """Wrap `simulator`; the noise has covariance L Lᵀ, where L is `noise_factor` (X, X)."""
        self.simulator = simulator
        self.noise_factor = noise_factor

    @property
    def state(self) -> Tensor:
        """The present states, noise included, (B, X)."""
        return self.simulator.state

    @property
    def blocked(self) -> Tensor:
        """Which states (B,) were stopped at the edge of the free space in the last step, bool."""
        return self.simulator.blocked

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set `rows` (n,), by default all, to `state` (n, X)."""
        self.simulator.reset_to(state, rows)

    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the new state (B, X)."""
        before = self.simulator.state
        landed = self.simulator.step(action)
        return self.simulator.settle(before, landed + torch.randn_like(landed) @ self.noise_factor.T)
