"""The neural-augmented simulator: an abstract simulator whose every step a residual model corrects."""

import torch
from torch import Tensor

from astra_data.learning.networks.residual import ResidualModel
from astra_data.worlds.protocols import PlacedSimulator


class AugmentedSimulator:
    """Step the simulator, add what the model says that it lacks, and set it there (Golemo et al. 2018).

    Attributes:
        state: corrected abstract states, (B, X). hidden: memory of the model, (B, M).
        blocked: (B,) bool, the last step or its correction was stopped at a wall.
    """

    def __init__(
        self,
        simulator: PlacedSimulator,
        model: ResidualModel,
        *,
        scatter: Tensor | None = None,
    ) -> None:
        """Wrap `simulator`.

        Args:
            simulator: the abstract simulator.
            model: trained; only read.
            scatter: factor (X, X) of the noise that stands for the target's scatter around the correction.
        """
        self.simulator = simulator
        self.model = model
        self.scatter = scatter
        self.hidden = model.initial_memory(len(simulator.state))

    @property
    def state(self) -> Tensor:
        """The corrected abstract states, (B, X)."""
        return self.simulator.state

    @property
    def blocked(self) -> Tensor:
        """Which were stopped at a wall, (B,) bool."""
        return self.simulator.blocked

    def reset_to(self, state: Tensor, rows: Tensor, hidden: Tensor | None = None) -> None:
        """Set `rows` (n,) to `state` (n, X), with the memory `hidden` (n, M), by default an empty one."""
        self.simulator.reset_to(state, rows)
        self.hidden[rows] = self.model.initial_memory(len(state)) if hidden is None else hidden

    @torch.no_grad()
    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the corrected state (B, X)."""
        before = self.simulator.state
        landed = self.simulator.step(action)
        sequence, self.hidden = self.model.correct(
            before.unsqueeze(1), action.unsqueeze(1), landed.unsqueeze(1), self.hidden
        )
        corrected = sequence.squeeze(1)
        if self.scatter is not None:
            corrected = corrected + torch.randn_like(corrected) @ self.scatter.T
        return self.simulator.settle(before, corrected)
