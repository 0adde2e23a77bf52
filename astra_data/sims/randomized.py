"""A simulator whose state is scattered after every step, by Gaussian noise of a given shape."""

import torch
from torch import Tensor

from astra_data.free_space import FreeSpace
from astra_data.simulator import SteppedSimulator


class RandomizedSimulator:
    """Step the simulator, add noise, keep the position in free space, set the simulator there.

    Attributes:
        state: (B, X). blocked: (B,) bool, the last step was stopped at the edge of the free space.
    """

    def __init__(self, simulator: SteppedSimulator, free: FreeSpace, noise_factor: Tensor) -> None:
        """Wrap `simulator`; the noise is `noise_factor` (X, X) times standard normal numbers."""
        self.simulator = simulator
        self.free = free
        self.noise_factor = noise_factor
        self.blocked = torch.zeros(len(simulator.state), dtype=torch.bool, device=simulator.state.device)

    @property
    def state(self) -> Tensor:
        """The scattered states, (B, X)."""
        return self.simulator.state

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set `rows` (n,), by default all, to `state` (n, X)."""
        self.simulator.reset_to(state, rows)

    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the new state (B, X)."""
        before = self.simulator.state
        landed = self.simulator.step(action)
        landed = landed + torch.randn_like(landed) @ self.noise_factor.T
        position, self.blocked = self.free.slide(before[:, :2], landed[:, :2])
        self.simulator.reset_to(torch.cat([position, landed[:, 2:]], dim=-1))
        return self.simulator.state
