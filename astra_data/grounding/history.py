"""A grounding by a history model: each step is corrected given a latent of the history (Algorithm 2)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
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
from astra_data.worlds.protocols import PlacedSimulator, WalledSimulator

_FAILURES, _MEMBERS = "failures", "members"
"""Of the tensors and sizes of a failure model, and of members, in files."""


class GroundedSimulator(EpisodeSimulator):
    """Step the simulator, correct where it landed, set it there, and encode the longer history.

    With members, each corrects its own share of the rows and predicts their rewards, by its own latents; the
    latents that policies observe are the model's in every row.

    Attributes:
        model: the trained grounding model; only read.
        members: models that were fitted to other draws of the episodes; only read.
        failures: the failure model, if one was fitted; only read.
        hidden: of the model's encoder, (B, Z). goal: (B, G).
        landed: where the simulator landed in the last step, before the correction, (B, X).
    """

    def __init__(
        self,
        simulator: PlacedSimulator,
        model: GroundingModel,
        scatter: Tensor | None = None,
        failures: FailureModel | None = None,
        members: tuple[GroundingModel, ...] = (),
        clearance_m: float | None = None,
    ) -> None:
        """Wrap `simulator`; `scatter` stands for the target's scatter around the correction.

        Corrections end no closer to walls than `clearance_m`.
        """
        super().__init__(simulator, scatter=scatter)
        if clearance_m is not None and isinstance(simulator, WalledSimulator):
            simulator.keep_clear(clearance_m)
        self.model, self.members, self.failures = model, members, failures
        shape, (count, _), device = model.shape, simulator.state.shape, simulator.state.device
        self.latent_size = shape.latent_size
        self.hidden = torch.zeros(count, shape.latent_size, device=device)
        self.goal = torch.zeros(count, shape.goal_size, device=device)
        self._own_hidden = self.hidden.clone() if members else None
        self._shares = _shares(members or (model,), count)
        self._last = self.latent, self._own_latent, torch.zeros(count, shape.action_size, device=device)
        self._predictions = torch.zeros(1, count, shape.state_size, device=device)
        self.landed = simulator.state
        self._remembered = torch.zeros(count, 0 if failures is None else failures.memory_size, device=device)
        self._hazard: Tensor | None = None

    @property
    def latent(self) -> Tensor:
        """The latents (B, Z) of the histories so far."""
        return self.model.encoder.latent(self.hidden)

    @property
    def _own_latent(self) -> Tensor:
        """The latents (B, Z) by the member of each row."""
        return self.latent if self._own_hidden is None else self.model.encoder.latent(self._own_hidden)

    @property
    @torch.no_grad()
    def disagreement(self) -> Tensor:
        """By how much more than on the data the last step's corrections differed, (B,).

        That is between each row's member and the model, or else between the heads of the correction. Zero
        before the first step, and where there is only one correction.
        """
        latent, _, action = self._last
        predictions = self._predictions
        if self.members:
            predictions = torch.stack([self.model.correct(latent, action, self.landed), predictions.mean(0)])
        if len(predictions) == 1:
            return torch.zeros_like(predictions[0, :, 0])
        apart = self._by_share(lambda model, rows: model.disagreement(predictions[:, rows]))
        return (apart - 1.0).clamp_min(0.0)

    def _by_share(self, of: Callable[[GroundingModel, slice], Tensor]) -> Tensor:
        """Return (B, ...) what the model that corrects it says `of` each row."""
        return torch.cat([of(model, rows) for model, rows in self._shares])

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
        latent_size, count = self.model.shape.latent_size, len(self.members)
        if previous_action is None:
            previous_action = torch.zeros(len(state), self.model.shape.action_size, device=state.device)
        if hidden is None:
            hidden = torch.zeros(len(state), latent_size * (1 + count), device=state.device)
        if self.failures is not None:
            self._remembered[rows] = self.failures.initial_memory(state, previous_action)
        first, *others = hidden.split(latent_size, dim=-1)
        self.hidden[rows] = _encoded(self.model, state, goal, previous_action, first)
        if self._own_hidden is not None:
            for before, (model, share) in zip(others, self._shares, strict=True):
                of = (rows >= share.start) & (rows < share.stop)
                inputs = (values[of] for values in (state, goal, previous_action, before))
                self._own_hidden[rows[of]] = _encoded(model, *inputs)

    @torch.no_grad()
    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the corrected states (B, X)."""
        before = self.state
        latent = self.latent
        own = latent if self._own_hidden is None else self._own_latent
        self._last = latent, own, action
        landed = self.landed = self.simulator.step(action)
        if self.failures is not None:
            soon, self._remembered = self.failures.step(before, action, landed, self._remembered)
            self._hazard = self.failures.hazard(soon)
        self._predictions = torch.cat(
            [
                model.ensemble_predictions(own[rows], action[rows], landed[rows])
                for model, rows in self._shares
            ],
            dim=1,
        )
        state = self._settle(before, self._predictions.mean(0))
        self.hidden = _encoded(self.model, state, self.goal, action, self.hidden)
        if (hidden := self._own_hidden) is not None:
            inputs = state, self.goal, action, hidden
            self._own_hidden = self._by_share(
                lambda model, rows: _encoded(model, *(values[rows] for values in inputs))
            )
        return state

    @torch.no_grad()
    def topple_risk(self) -> Tensor:
        """Return the probability (B,) that the target toppled in the last step."""
        if self._hazard is not None:
            return self._hazard
        _, *known = self._last
        known.append(self.state)
        return self._by_share(lambda model, rows: model.topple_risk(*(values[rows] for values in known)))

    @torch.no_grad()
    def predicted_reward(self, own: Tensor, *, with_failures: bool = True) -> Tensor:
        """Return the target's reward (B,) of the last step, by R_pred; see `EpisodeSimulator`."""
        _, latent, action = self._last
        hazard = self._hazard if with_failures else torch.zeros_like(own)
        known = [latent, action, own, *([] if hazard is None else [hazard])]
        return self._by_share(lambda model, rows: model.target_reward(*(values[rows] for values in known)))

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs to continue from here."""
        own = {} if self._own_hidden is None else {"own_hidden": self._own_hidden}
        remembered = {} if self.failures is None else {"remembered": self._remembered}
        return super().state_dict() | {"goal": self.goal, "hidden": self.hidden} | own | remembered

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        super().load_state_dict(state)
        self.goal, self.hidden = state["goal"].clone(), state["hidden"].clone()
        if self._own_hidden is not None:
            self._own_hidden = state["own_hidden"].clone()
        if self.failures is not None:
            self._remembered = state["remembered"].clone()


def _shares(models: Sequence[GroundingModel], count: int) -> list[tuple[GroundingModel, slice]]:
    """Divide `count` rows among `models`, as equally as they can be: rows keep their model."""
    ends = [round(count * number / len(models)) for number in range(len(models) + 1)]
    return [(model, slice(*between)) for model, between in zip(models, pairwise(ends), strict=True)]


def _encoded(
    model: GroundingModel, state: Tensor, goal: Tensor, previous_action: Tensor, hidden: Tensor
) -> Tensor:
    """Return the hidden states (n, Z) of a model's encoder after one more step."""
    return model.encoder.step(model.encoder_input(state, goal, previous_action), hidden)


@dataclass(frozen=True)
class HistoryGrounding(FittedGrounding):
    """Correct each step by a history model, whose latents policies observe.

    Attributes:
        model: fitted to all training episodes. failures: the failure model, if there is one.
        members: models that were fitted to other draws of the episodes, and correct in its place.
        clearance_m: how close to walls corrections may end; None for as close as the simulator itself.
    """

    kind: ClassVar[str] = "history"

    model: GroundingModel
    failures: FailureModel | None = None
    members: tuple[GroundingModel, ...] = ()
    clearance_m: float | None = None

    @property
    def encoder(self) -> GroundingModel:
        """The model, whose encoder is ψ^s."""
        return self.model

    def reduced(self, *, members: bool, failures: bool) -> "HistoryGrounding":
        """Return the grounding without what is not asked for."""
        return replace(
            self, failures=self.failures if failures else None, members=self.members if members else ()
        )

    def for_replay(self) -> "HistoryGrounding":
        """Return the model alone."""
        return self.reduced(members=False, failures=False)

    def corrected(self, simulator: PlacedSimulator, scatter: Tensor | None) -> GroundedSimulator:
        """Wrap `simulator`; see `Grounding.corrected`."""
        return GroundedSimulator(
            simulator, self.model, scatter, self.failures, self.members, self.clearance_m
        )

    @torch.no_grad()
    def hidden_before(self, windows: PairedWindows, every: int = 1) -> Tensor:
        """Return what is remembered before each `every`-th step, (E, ceil(T / every), H).

        That is the hidden state of the model's encoder and of each member's; a failure model looks at nothing
        but the simulation.
        """
        after = torch.cat([model.encode(windows)[1] for model in (self.model, *self.members)], dim=-1)
        return functional.pad(after[:, :-1], (0, 0, 1, 0))[:, ::every]

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
        if self.clearance_m is not None:
            metadata["clearance_m"] = self.clearance_m
        if self.members:
            metadata[_MEMBERS] = len(self.members)
        for number, member in enumerate(self.members):
            tensors |= {f"{_MEMBERS}.{number}.{name}": one for name, one in member.state_dict().items()}
        return tensors, metadata

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        """Read what `to_file` returned."""
        prefixes = f"{_FAILURES}.", f"{_MEMBERS}."
        own = {name: one for name, one in tensors.items() if not name.startswith(prefixes)}
        shape, failures = GroundingShape(**_tuples(metadata["shape"])), None
        if _FAILURES in metadata:
            failures = FailureModel(FailureShape(**_tuples(metadata[_FAILURES])))
            failures.load_state_dict(_within(tensors, _FAILURES))
            failures = failures.to(device).requires_grad_(False).eval()
        others = [_within(tensors, f"{_MEMBERS}.{number}") for number in range(metadata.get(_MEMBERS, 0))]
        model, *members = (
            _loaded(GroundingModel(shape, metadata["target"]), weights, device) for weights in (own, *others)
        )
        return cls(model, failures, tuple(members), metadata.get("clearance_m"))


def _loaded(model: GroundingModel, weights: Mapping[str, Tensor], device: str) -> GroundingModel:
    model.load_state_dict(weights)
    return model.to(device).requires_grad_(False).eval()


def _within(tensors: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    """Return the tensors of a `part`, by their names within it."""
    prefix = f"{part}."
    return {name.removeprefix(prefix): one for name, one in tensors.items() if name.startswith(prefix)}


def _tuples(shape: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sizes of a shape as they were before JSON made lists of tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in shape.items()}
