"""The grounded simulator: an abstract simulator corrected every step by a history model (Algorithm 2)."""

import torch
from torch import Tensor

from astra_data.learning.networks.grounding import GroundingModel
from astra_data.worlds.protocols import PlacedSimulator


class GroundedSimulator:
    """Step the simulator, correct where it landed, set it back there, and encode the history anew.

    Attributes:
        state: corrected abstract states, (B, X). latent: z, (B, Z).
        blocked: (B,) bool, the last step or its correction was stopped at a wall.
    """

    def __init__(
        self,
        simulator: PlacedSimulator,
        model: GroundingModel,
        *,
        scatter: Tensor | None = None,
    ) -> None:
        """Wrap `simulator`.

        Args:
            simulator: the abstract simulator.
            model: a trained grounding model; only read.
            scatter: factor (X, X) of the noise that stands for the target's scatter around the correction.
        """
        self.simulator = simulator
        self.model = model
        self.scatter = scatter
        count, device = len(simulator.state), simulator.state.device
        shape = model.shape
        self.hidden = torch.zeros(count, shape.latent_size, device=device)
        self.goal = torch.zeros(count, shape.goal_size, device=device)
        self._opinions = torch.zeros(1, count, shape.state_size, device=device)

    @property
    def state(self) -> Tensor:
        """The corrected abstract states, (B, X)."""
        return self.simulator.state

    @property
    def blocked(self) -> Tensor:
        """Which were stopped at a wall, (B,) bool."""
        return self.simulator.blocked

    @property
    def latent(self) -> Tensor:
        """The latents (B, Z) of the histories so far."""
        return self.model.encoder.latent(self.hidden)

    @property
    def doubt(self) -> Tensor:
        """By how much more than usual the correction's heads disagreed on the last step, (B,).

        Zero before the first step, and where there is but one head.
        """
        if len(self._opinions) == 1:
            return torch.zeros_like(self._opinions[0, :, 0])
        return (self.model.doubt(self._opinions) - 1.0).clamp_min(0.0)

    @torch.no_grad()
    def reset_to(
        self,
        state: Tensor,
        rows: Tensor,
        goal: Tensor,
        *,
        hidden: Tensor | None = None,
        previous_action: Tensor | None = None,
    ) -> None:
        """Set `rows` (n,) to `state` (n, X) with `goal` (n, G), at the start or within a known history.

        Args:
            state: abstract states.
            rows: which.
            goal: their goals.
            hidden: hidden states (n, Z) of the history before `state`, by default none.
            previous_action: the actions (n, A) that led to `state`, by default zero.
        """
        self.simulator.reset_to(state, rows)
        self.goal[rows] = goal
        if previous_action is None:
            previous_action = torch.zeros(len(state), self.model.shape.action_size, device=state.device)
        if hidden is None:
            hidden = torch.zeros(len(state), self.model.shape.latent_size, device=state.device)
        self.hidden[rows] = self.model.encoder.step(
            self.model.encoder_input(state, goal, previous_action), hidden
        )

    @torch.no_grad()
    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the corrected state (B, X)."""
        before = self.simulator.state
        self._opinions = self.model.opinions(self.latent, action, self.simulator.step(action))
        corrected = self._opinions.mean(0)
        if self.scatter is not None:
            corrected = corrected + torch.randn_like(corrected) @ self.scatter.T
        state = self.simulator.settle(before, corrected)
        self.hidden = self.model.encoder.step(self.model.encoder_input(state, self.goal, action), self.hidden)
        return state
