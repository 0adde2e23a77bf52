"""A grounding by a residual model: an LSTM corrects each step of the simulator (Golemo et al. 2018)."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from astra_data.core.checkpoint import loaded
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import FittedGrounding
from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.learning.networks.paired_windows import PairedWindows
from astra_data.learning.networks.residual import ResidualModel, ResidualShape
from astra_data.worlds.protocols import PlacedSimulator


class ResidualSimulator(EpisodeSimulator):
    """Step the simulator, add the correction that the residual model predicts, and set it there.

    Attributes:
        model: the trained residual model; only read.
        hidden: its memory, (B, M).
    """

    def __init__(
        self, simulator: PlacedSimulator, model: ResidualModel, *, scatter: Tensor | None = None
    ) -> None:
        """Wrap `simulator`; `scatter` stands for the target's scatter around the correction."""
        super().__init__(simulator, scatter=scatter)
        self.model = model
        self.hidden = model.initial_memory(len(simulator.state))

    def start(
        self,
        state: Tensor,
        rows: Tensor,
        goal: Tensor,
        *,
        hidden: Tensor | None = None,
        previous_action: Tensor | None = None,
    ) -> None:
        """Start episodes in `rows` (n,); see `EpisodeSimulator.start`."""
        super().start(state, rows, goal)
        self.hidden[rows] = self.model.initial_memory(len(state)) if hidden is None else hidden

    @torch.no_grad()
    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the corrected states (B, X)."""
        before = self.state
        landed = self.simulator.step(action)
        sequence, self.hidden = self.model.correct(
            before.unsqueeze(1), action.unsqueeze(1), landed.unsqueeze(1), self.hidden
        )
        return self._settle(before, sequence.squeeze(1))

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs to continue from here."""
        return super().state_dict() | {"hidden": self.hidden}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        super().load_state_dict(state)
        self.hidden = state["hidden"].clone()


@dataclass(frozen=True)
class ResidualGrounding(FittedGrounding):
    """Correct each step by a residual model; policies observe no latent."""

    kind: ClassVar[str] = "residual"
    start_stride: ClassVar[int] = 10
    """The LSTM's memory is kept for each recorded step to start from: for all of 100 k steps, 300 MB."""

    model: ResidualModel

    def corrected(self, simulator: PlacedSimulator, scatter: Tensor | None) -> ResidualSimulator:
        """Wrap `simulator`; see `Grounding.corrected`."""
        return ResidualSimulator(simulator, self.model, scatter=scatter)

    @torch.no_grad()
    def hidden_before(self, windows: PairedWindows, every: int = 1) -> Tensor:
        """Return the LSTM's memory before each `every`-th step, (E, ceil(T / every), M)."""
        memory, before = self.model.initial_memory(len(windows.state)), []
        for first in range(0, windows.state.shape[1], every):
            before.append(memory)
            steps = slice(first, first + every)
            _, memory = self.model.correct(
                windows.state[:, steps], windows.action[:, steps], windows.simulated_next[:, steps], memory
            )
        return torch.stack(before, dim=1)

    def scatter(self, episodes: PairedEpisodes) -> Tensor:
        """Return the factor (X, X) of the scatter around the correction, as fitted on held-out episodes."""
        return self.model.residual_factor

    def to_file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return weights and sizes."""
        return self.model.state_dict(), {"shape": asdict(self.model.shape)}

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        """Read what `to_file` returned."""
        return cls(loaded(ResidualModel(ResidualShape(**metadata["shape"])), tensors, device))
