"""A grounding by a history model: each step is corrected given a latent of the history (Algorithm 2)."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.nn import functional

from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import FittedGrounding
from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.learning.networks.paired_windows import PairedWindows
from astra_data.worlds.protocols import PlacedSimulator


class GroundedSimulator(EpisodeSimulator):
    """Step the simulator, correct where it landed, set it there, and encode the longer history.

    Attributes:
        model: the trained grounding model; only read.
        hidden: of its encoder, (B, Z). goal: (B, G).
    """

    def __init__(
        self, simulator: PlacedSimulator, model: GroundingModel, *, scatter: Tensor | None = None
    ) -> None:
        """Wrap `simulator`; `scatter` stands for the target's scatter around the correction."""
        super().__init__(simulator, scatter=scatter)
        self.model = model
        shape, (count, _), device = model.shape, simulator.state.shape, simulator.state.device
        self.latent_size = shape.latent_size
        self.hidden = torch.zeros(count, shape.latent_size, device=device)
        self.goal = torch.zeros(count, shape.goal_size, device=device)
        self._last = self.latent, torch.zeros(count, shape.action_size, device=device)
        self._predictions = torch.zeros(1, count, shape.state_size, device=device)
        self._rows = torch.arange(count, device=device)
        self._heads: Tensor | None = None

    @property
    def latent(self) -> Tensor:
        """The latents (B, Z) of the histories so far."""
        return self.model.encoder.latent(self.hidden)

    @property
    def disagreement(self) -> Tensor:
        """By how much more than on the data the correction's heads disagreed on the last step, (B,).

        Zero before the first step, and where there is only one head.
        """
        if len(self._predictions) == 1:
            return torch.zeros_like(self._predictions[0, :, 0])
        return (self.model.disagreement(self._predictions) - 1.0).clamp_min(0.0)

    @torch.no_grad()
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
        self.goal[rows] = goal
        shape = self.model.shape
        if self._heads is not None:
            self._heads[rows] = self._drawn_heads(len(rows))
        if previous_action is None:
            previous_action = torch.zeros(len(state), shape.action_size, device=state.device)
        if hidden is None:
            hidden = torch.zeros(len(state), shape.latent_size, device=state.device)
        inputs = self.model.encoder_input(state, goal, previous_action)
        self.hidden[rows] = self.model.encoder.step(inputs, hidden)

    @torch.no_grad()
    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the corrected states (B, X)."""
        before = self.state
        self._last = self.latent, action
        landed = self.simulator.step(action)
        self._predictions = self.model.ensemble_predictions(*self._last, landed)
        one = self._predictions.mean(0) if self._heads is None else self._predictions[self._heads, self._rows]
        state = self._settle(before, one)
        self.hidden = self.model.encoder.step(self.model.encoder_input(state, self.goal, action), self.hidden)
        return state

    def keep_heads(self) -> None:
        """Correct each row by one head of the ensemble, drawn now and at each start, not by their mean."""
        self._heads = self._drawn_heads(len(self._rows))

    def _drawn_heads(self, count: int) -> Tensor:
        return torch.randint(self.model.shape.correction_heads, (count,), device=self._rows.device)

    @torch.no_grad()
    def topple_risk(self) -> Tensor:
        """Return the probability (B,) that the target toppled in the last step."""
        return self.model.topple_risk(*self._last, self.state)

    @torch.no_grad()
    def predicted_reward(self, own: Tensor) -> Tensor:
        """Return the target's reward (B,) of the last step, by R_pred; see `EpisodeSimulator`."""
        return self.model.target_reward(*self._last, own)

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs to continue from here."""
        heads = {} if self._heads is None else {"heads": self._heads}
        return super().state_dict() | {"goal": self.goal, "hidden": self.hidden} | heads

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        super().load_state_dict(state)
        self.goal, self.hidden = state["goal"].clone(), state["hidden"].clone()
        if self._heads is not None:
            self._heads = state["heads"].clone()


@dataclass(frozen=True)
class HistoryGrounding(FittedGrounding):
    """Correct each step by a history model, whose latents policies observe."""

    kind: ClassVar[str] = "history"

    model: GroundingModel

    @property
    def encoder(self) -> GroundingModel:
        """The model, whose encoder is ψ^s."""
        return self.model

    def corrected(self, simulator: PlacedSimulator, scatter: Tensor | None) -> GroundedSimulator:
        """Wrap `simulator`; see `Grounding.corrected`."""
        return GroundedSimulator(simulator, self.model, scatter=scatter)

    @torch.no_grad()
    def hidden_before(self, windows: PairedWindows, every: int = 1) -> Tensor:
        """Return the encoder's hidden states before each `every`-th step, (E, ceil(T / every), Z)."""
        _, after = self.model.encode(windows)
        return functional.pad(after[:, :-1], (0, 0, 1, 0))[:, ::every]

    def scatter(self, episodes: PairedEpisodes) -> Tensor:
        """Return the factor (X, X) of the scatter around the correction, as fitted on held-out episodes."""
        return self.model.residual_factor

    def to_file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return weights and sizes."""
        return self.model.state_dict(), {"shape": asdict(self.model.shape), "target": self.model.target}

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        """Read what `to_file` returned; JSON made lists of tuples."""
        shape: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value
            for key, value in metadata["shape"].items()
        }
        model = GroundingModel(GroundingShape(**shape), metadata["target"])
        model.load_state_dict(tensors)
        return cls(model.to(device).requires_grad_(False).eval())
