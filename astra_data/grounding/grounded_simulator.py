"""The simulator as a history model corrects it: each step given a latent of the history (Algorithm 2)."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.learning.networks.failure import FailureModel
from astra_data.learning.networks.grounding import GroundingModel
from astra_data.learning.networks.scatter import ScatterModel
from astra_data.worlds.protocols import PlacedSimulator, keep_clear


class GroundedSimulator(EpisodeSimulator):
    """Step the simulator, correct where it landed, set it there, and encode the longer history.

    With members, each corrects its own share of the rows and predicts their rewards, by its own latents; the
    latents that policies observe are the model's in every row.

    Attributes:
        model: the trained grounding model; only read.
        members: models that were fitted to other draws of the episodes; only read.
        failures: the failure model, if one was fitted; only read.
        scatter_model: the model of the target's scatter around the correction, if one was fitted; only read.
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
        scatter_model: ScatterModel | None = None,
    ) -> None:
        """Wrap `simulator`; `scatter`, of the same size at every moment, is added to that of `scatter_model`.

        Corrections end no closer to walls than `clearance_m`.
        """
        super().__init__(simulator, scatter=scatter)
        if clearance_m is not None:
            keep_clear(simulator, clearance_m)
        self.model, self.members, self.failures, self.scatter_model = model, members, failures, scatter_model
        shape, (count, _), device = model.shape, simulator.state.shape, simulator.state.device
        self.latent_size = shape.latent_size
        self.hidden = torch.zeros(count, shape.latent_size, device=device)
        self.goal = torch.zeros(count, shape.goal_size, device=device)
        self._own_hidden = self.hidden.clone() if members else None
        self._shares = _shares(members or (model,), count)
        self._last = self.latent, self._own_latent, torch.zeros(count, shape.action_size, device=device)
        self._predictions = torch.empty(0, count, shape.state_size, device=device)
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
        if self.members and len(predictions):
            predictions = torch.stack([self.model.correct(latent, action, self.landed), predictions.mean(0)])
        if len(predictions) < 2:
            return torch.zeros_like(self.landed[:, 0])
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
        """Start episodes in `rows` (n,); see `EpisodeSimulator.start`.

        `hidden` is that of the model's encoder and of each member's, followed by the averages of the failure
        model, if they are known.
        """
        super().start(state, rows, goal)
        self.goal[rows] = goal
        latent_size, count = self.model.shape.latent_size, len(self.members)
        if previous_action is None:
            previous_action = torch.zeros(len(state), self.model.shape.action_size, device=state.device)
        if hidden is None:
            hidden = torch.zeros(len(state), latent_size * (1 + count), device=state.device)
        hidden, averages = hidden.tensor_split([latent_size * (1 + count)], dim=-1)
        if self.failures is not None:
            known = averages if averages.shape[-1] else None
            self._remembered[rows] = self.failures.initial_memory(state, previous_action, known)
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
        corrected = self._predictions.mean(0)
        if self.scatter_model is not None:
            corrected = corrected + self.scatter_model.draw(
                self.model.correction_inputs(latent, action, landed)
            )
        state = self._settle(before, corrected)
        self.hidden = _encoded(self.model, state, self.goal, action, self.hidden)
        if (hidden := self._own_hidden) is not None:
            inputs = state, self.goal, action, hidden
            self._own_hidden = self._by_share(
                lambda model, rows: _encoded(model, *(values[rows] for values in inputs))
            )
        return state

    @torch.no_grad()
    def failure_risk(self) -> Tensor:
        """Return the probability (B,) that the target failed in the last step."""
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
