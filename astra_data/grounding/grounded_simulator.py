"""The simulator as a history model corrects it: each step given a latent of the history (Algorithm 2)."""

import torch
from torch import Tensor

from astra_data.grounding.networks.failure import FailureModel
from astra_data.grounding.networks.grounding import GroundingModel
from astra_data.grounding.networks.scatter import ScatterModel
from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.worlds.protocols import PlacedSimulator, keep_clear


class GroundedSimulator(EpisodeSimulator):
    """Step the simulator, correct where it landed, set it there, and encode the longer history.

    Attributes:
        model: the trained grounding model; only read.
        failures: the failure model, if one is used; only read.
        scatter_model: the model of the target's scatter around the correction, if one is used; only read.
        hidden: of the encoder, (B, Z). goal: (B, G).
        landed: where the simulator landed in the last step, before the correction, (B, X).
    """

    def __init__(
        self,
        simulator: PlacedSimulator,
        model: GroundingModel,
        failures: FailureModel | None = None,
        scatter_model: ScatterModel | None = None,
        clearance_m: float | None = None,
        *,
        fails_at_walls: bool = False,
    ) -> None:
        """Wrap `simulator`; corrections end no closer to walls than `clearance_m`.

        With `fails_at_walls`, states are `blocked` where their correction touches a wall, not their scatter.
        """
        super().__init__(simulator)
        self._touches: Tensor | None = simulator.blocked if fails_at_walls else None
        if clearance_m is not None:
            keep_clear(simulator, clearance_m)
        self.model, self.failures, self.scatter_model = model, failures, scatter_model
        shape, (count, _), device = model.shape, simulator.state.shape, simulator.state.device
        self.latent_size = shape.latent_size
        self.hidden = torch.zeros(count, shape.latent_size, device=device)
        self.goal = torch.zeros(count, shape.goal_size, device=device)
        self._last = self.latent, torch.zeros(count, shape.action_size, device=device)
        self.landed = simulator.state
        self._remembered = torch.zeros(count, 0 if failures is None else failures.memory_size, device=device)
        self._hazard: Tensor | None = None

    @property
    def blocked(self) -> Tensor:
        """Which states were stopped at a wall in the last step, (B,) bool."""
        return self.simulator.blocked if self._touches is None else self._touches

    @property
    def latent(self) -> Tensor:
        """The latents (B, Z) of the histories so far."""
        return self.model.encoder.latent(self.hidden)

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

        `hidden` is that of the encoder, followed by the averages of the failure model, if they are known.
        """
        super().start(state, rows, goal)
        if self._touches is not None:
            self._touches = self._touches.index_fill(0, rows, False)
        self.goal[rows] = goal
        latent_size = self.latent_size
        if previous_action is None:
            previous_action = torch.zeros(len(state), self.model.shape.action_size, device=state.device)
        if hidden is None:
            hidden = torch.zeros(len(state), latent_size, device=state.device)
        hidden, averages = hidden.tensor_split([latent_size], dim=-1)
        if self.failures is not None:
            known = averages if averages.shape[-1] else None
            self._remembered[rows] = self.failures.initial_memory(state, previous_action, known)
        self.hidden[rows] = self._encoded(state, goal, previous_action, hidden)

    @torch.no_grad()
    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the corrected states (B, X)."""
        before, latent = self.state, self.latent
        self._last = latent, action
        landed = self.landed = self.simulator.step(action)
        if self.failures is not None:
            soon, self._remembered = self.failures.step(before, action, landed, latent, self._remembered)
            self._hazard = self.failures.hazard(soon)
        state = corrected = self.model.correct(latent, action, landed)
        if self._touches is not None or self.scatter_model is None:
            state = self._settle(before, corrected)
            self._touches = None if self._touches is None else self.simulator.blocked
        if self.scatter_model is not None:
            scatter = self.scatter_model.draw(self.model.correction_inputs(latent, action, landed))
            state = self._settle(before, state + scatter)
        self.hidden = self._encoded(state, self.goal, action, self.hidden)
        return state

    def _encoded(self, state: Tensor, goal: Tensor, previous_action: Tensor, hidden: Tensor) -> Tensor:
        """Return the encoder's hidden states (n, Z) after one more step."""
        return self.model.encoder.step(self.model.encoder_input(state, goal, previous_action), hidden)

    def failure_risk(self) -> Tensor | None:
        """Return the probability (B,) that the target failed in the last step; None if unknown."""
        return self._hazard

    @torch.no_grad()
    def predicted_reward(self, own: Tensor) -> Tensor:
        """Return the target's reward (B,) of the last step, by R_pred; see `EpisodeSimulator`."""
        latent, action = self._last
        return self.model.target_reward(latent, action, own, self._hazard)

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs to continue from here."""
        remembered = {} if self.failures is None else {"remembered": self._remembered}
        return super().state_dict() | {"goal": self.goal, "hidden": self.hidden} | remembered

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        super().load_state_dict(state)
        self.goal, self.hidden = state["goal"].clone(), state["hidden"].clone()
        if self.failures is not None:
            self._remembered = state["remembered"].clone()
