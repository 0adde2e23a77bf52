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
from astra_data.learning.networks.failure import FailureModel, FailureShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.learning.networks.paired_windows import PairedWindows
from astra_data.worlds.protocols import PlacedSimulator

_FAILURES = "failures"
"""Of a failure model's tensors and sizes in files."""


class GroundedSimulator(EpisodeSimulator):
    """Step the simulator, correct where it landed, set it there, and encode the longer history.

    Attributes:
        model: the trained grounding model; only read.
        failures: the failure model, if one was fitted; only read.
        hidden: of the encoder, (B, Z). goal: (B, G).
    """

    def __init__(
        self,
        simulator: PlacedSimulator,
        model: GroundingModel,
        *,
        scatter: Tensor | None = None,
        failures: FailureModel | None = None,
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
        self.failures = failures
        self._remembered = torch.zeros(count, 0 if failures is None else failures.memory_size, device=device)
        self._hazard: Tensor | None = None

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
        remembered = None
        if hidden is None:
            hidden = torch.zeros(len(state), shape.latent_size, device=state.device)
        elif self.failures is not None:
            hidden, remembered = hidden.split([shape.latent_size, self.failures.memory_size], dim=-1)
        if self.failures is not None:
            if remembered is None:
                remembered = self.failures.initial_memory(state, previous_action)
            self._remembered[rows] = remembered
        inputs = self.model.encoder_input(state, goal, previous_action)
        self.hidden[rows] = self.model.encoder.step(inputs, hidden)

    @torch.no_grad()
    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the corrected states (B, X)."""
        before = self.state
        self._last = self.latent, action
        landed = self.simulator.step(action)
        if self.failures is not None:
            soon, self._remembered = self.failures.step(before, action, landed, self._remembered)
            self._hazard = self.failures.hazard(soon)
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
        return self._hazard if self._hazard is not None else self.model.topple_risk(*self._last, self.state)

    @torch.no_grad()
    def predicted_reward(self, own: Tensor) -> Tensor:
        """Return the target's reward (B,) of the last step, by R_pred; see `EpisodeSimulator`."""
        return self.model.target_reward(*self._last, own, self._hazard)

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs to continue from here."""
        heads = {} if self._heads is None else {"heads": self._heads}
        remembered = {} if self.failures is None else {"remembered": self._remembered}
        return super().state_dict() | {"goal": self.goal, "hidden": self.hidden} | heads | remembered

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        super().load_state_dict(state)
        self.goal, self.hidden = state["goal"].clone(), state["hidden"].clone()
        if self._heads is not None:
            self._heads = state["heads"].clone()
        if self.failures is not None:
            self._remembered = state["remembered"].clone()


@dataclass(frozen=True)
class HistoryGrounding(FittedGrounding):
    """Correct each step by a history model, whose latents policies observe; it may have a failure model."""

    kind: ClassVar[str] = "history"

    model: GroundingModel
    failures: FailureModel | None = None

    @property
    def encoder(self) -> GroundingModel:
        """The model, whose encoder is ψ^s."""
        return self.model

    def corrected(self, simulator: PlacedSimulator, scatter: Tensor | None) -> GroundedSimulator:
        """Wrap `simulator`; see `Grounding.corrected`."""
        return GroundedSimulator(simulator, self.model, scatter=scatter, failures=self.failures)

    @torch.no_grad()
    def hidden_before(self, windows: PairedWindows, every: int = 1) -> Tensor:
        """Return what is remembered before each `every`-th step, (E, ceil(T / every), H).

        That is the encoder's hidden state, and the failure model's memory if there is one.
        """
        _, after = self.model.encode(windows)
        hidden = functional.pad(after[:, :-1], (0, 0, 1, 0))
        if self.failures is not None:
            hidden = torch.cat([hidden, self.failures.histories(windows)[1]], dim=-1)
        return hidden[:, ::every]

    def scatter(self, episodes: PairedEpisodes) -> Tensor:
        """Return the factor (X, X) of the scatter around the correction, as fitted on held-out episodes."""
        return self.model.residual_factor

    def to_file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return weights and sizes."""
        tensors = self.model.state_dict()
        metadata: dict[str, Any] = {"shape": asdict(self.model.shape), "target": self.model.target}
        if self.failures is not None:
            tensors |= {f"{_FAILURES}.{name}": one for name, one in self.failures.state_dict().items()}
            metadata[_FAILURES] = asdict(self.failures.shape)
        return tensors, metadata

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        """Read what `to_file` returned."""
        model = GroundingModel(GroundingShape(**_tuples(metadata["shape"])), metadata["target"])
        prefix, failures = f"{_FAILURES}.", None
        model.load_state_dict({name: one for name, one in tensors.items() if not name.startswith(prefix)})
        if _FAILURES in metadata:
            failures = FailureModel(FailureShape(**_tuples(metadata[_FAILURES])))
            own = {name.removeprefix(prefix): one for name, one in tensors.items() if name.startswith(prefix)}
            failures.load_state_dict(own)
            failures = failures.to(device).requires_grad_(False).eval()
        return cls(model.to(device).requires_grad_(False).eval(), failures)


def _tuples(shape: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sizes of a shape as they were before JSON made lists of tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in shape.items()}
