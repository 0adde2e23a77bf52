"""A grounding by a history model: each step is corrected given a latent of the history (Algorithm 2)."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from astra_data.core.checkpoint import as_part, loaded, of_json, part_of
from astra_data.core.seeding import derive
from astra_data.grounding.descent import Descent, DescentConfig
from astra_data.grounding.encoder import mlp
from astra_data.grounding.failures import FailureModel, FailureShape
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.paired_episodes import PairedEpisodes, PairedWindows
from astra_data.grounding.simulator import EpisodeSimulator, FittedGrounding, PlacedSimulator
from astra_data.worlds.commands import innermost

_MOST = 2.0  # of the logarithm of a scale: off the data no moment shall scatter by more than e² times the usual
_DESCENT = DescentConfig(updates=500, learning_rate=2e-3)
_BATCH = 2048
_HITS_DESCENT, _HITS_DECAY, _HITS_BATCH = DescentConfig(updates=1500, learning_rate=2e-3), 0.01, 512
_ROLLS_M_S = 0.15  # balls that are measured to be slower lie
_MOST_FORMS = 20_000
_FAILURES, _SCATTER = "failures", "scatter"  # prefixes of the tensors and sizes of the two models in files


@dataclass(frozen=True)
class ScatterShape:
    """Sizes of the scatter model."""

    input_size: int  # I, of what the correction sees
    state_size: int  # X
    forms: int  # F, residuals that are kept to draw from
    hidden_sizes: tuple[int, ...] = (64, 64)


class ScatterModel(nn.Module):
    """Draw residuals of a correction: a scale told by the moment, times the form of a recorded residual."""

    def __init__(self, shape: ScatterShape) -> None:
        super().__init__()
        self.shape = shape
        self.network = mlp((shape.input_size, *shape.hidden_sizes, shape.state_size))
        for parameter in list(self.network.parameters())[-2:]:  # an untrained network says that every moment is usual
            nn.init.zeros_(parameter)
        self.usual = nn.Buffer(torch.ones(shape.state_size))  # deviation of the residuals, (X,)
        self.forms = nn.Buffer(torch.zeros(shape.forms, shape.state_size))
        """Residuals of held-out steps in units of their scales, (F, X)."""

    def log_scale(self, inputs: Tensor) -> Tensor:
        """Return the logarithm of the scale (..., X), in units of the usual, given `inputs` (..., I)."""
        return _MOST * torch.tanh(self.network(inputs) / _MOST)

    def nll(self, inputs: Tensor, residual: Tensor) -> Tensor:
        """Return the negative log-likelihood (..., X), but for a constant, of residuals (..., X)."""
        log_scale = self.log_scale(inputs)
        return log_scale + 0.5 * (residual / self.usual / log_scale.exp()).square()

    def in_units(self, inputs: Tensor, residual: Tensor) -> Tensor:
        """Return residuals (..., X) in units of their scales."""
        return residual / self.usual / self.log_scale(inputs).exp()

    def draw(self, inputs: Tensor) -> Tensor:
        """Draw a residual for each of `inputs` (B, I), (B, X)."""
        forms = self.forms[torch.randint(len(self.forms), (len(inputs),), device=inputs.device)]
        return forms * self.usual * self.log_scale(inputs).exp()


def fit_scatter(
    model: GroundingModel, training: PairedEpisodes, held_out: PairedEpisodes, seed: int
) -> tuple[ScatterModel, dict[str, Any]]:
    """Fit scales to the training residuals, take forms from held-out ones; return model and its figures on these."""
    inputs, residual = _residuals(model, training)
    seen, unexplained = _residuals(model, held_out)
    forms = min(len(seen), _MOST_FORMS)
    torch.manual_seed(derive(seed, "scatter model"))
    scatters = ScatterModel(ScatterShape(inputs.shape[1], residual.shape[1], forms)).to(inputs.device)
    scatters.usual.copy_(_deviation(residual).clamp_min(1e-6))
    descent = Descent(scatters, _DESCENT)
    while not descent.is_over:
        rows = torch.randint(len(inputs), (_BATCH,), device=inputs.device)
        descent.update(scatters.nll(inputs[rows], residual[rows]).mean())
    scatters.requires_grad_(False).eval()
    in_units = scatters.in_units(seen, unexplained)
    scatters.forms.copy_(in_units[torch.randperm(len(seen))[:forms]])
    usual, log_scale = _deviation(unexplained / scatters.usual), scatters.log_scale(seen)
    gains = usual.log() - _deviation(in_units).log() - log_scale.mean(0)
    kurtosis = in_units.pow(4).mean(0) / in_units.square().mean(0).square()
    scattered = usual > 0
    if model.hits is not None:
        scatters.usual[-2:] = 0.0  # hits are drawn by simulators
    return scatters, {
        "gain_nats": float(gains[scattered].sum()),
        "kurtosis": float(kurtosis[scattered].mean()) if scattered.any() else None,
    }


def fit_hits(model: GroundingModel, training: PairedEpisodes, seed: int) -> None:
    """Fit which share of the simulator's velocity of a ball comes true, to the steps in which it rolls there."""
    assert model.hits is not None
    torch.manual_seed(derive(seed, "hits"))
    inputs, _ = _residuals(model, training)
    simulated, recorded = map(training.steps, (training.windows.simulated_next, training.windows.next_state))
    rolls = (simulated[:, -2:].norm(dim=-1) > _ROLLS_M_S).nonzero().squeeze(1)
    descent = Descent(model.hits, _HITS_DESCENT, weight_decay=_HITS_DECAY)
    while len(rolls) and not descent.is_over:
        rows = rolls[torch.randint(len(rolls), (_HITS_BATCH,), device=rolls.device)]
        error = model.rolling(inputs[rows], simulated[rows]) - recorded[rows, -2:]
        descent.update(error.square().sum(-1).mean())


@torch.no_grad()
def _residuals(model: GroundingModel, episodes: PairedEpisodes) -> tuple[Tensor, Tensor]:
    """Return what the correction sees of each step (N, I), and what it leaves unexplained (N, X)."""
    windows = episodes.windows
    latent, _ = model.encode(windows)
    known = latent, windows.action, windows.simulated_next
    residual = windows.next_state - model.correct(*known)
    return episodes.steps(model.correction_inputs(*known)), episodes.steps(residual)


def _deviation(values: Tensor) -> Tensor:
    """Return the root mean square (X,) of values (N, X)."""
    return values.square().mean(0).sqrt()


class GroundedSimulator(EpisodeSimulator):
    """Step the simulator, correct where it landed, set it there; `hidden` (B, M) is the encoder's memory."""

    def __init__(self, simulator: PlacedSimulator, grounding: "HistoryGrounding") -> None:
        super().__init__(simulator)
        # States are `blocked` where their correction touches a wall, not their scatter.
        self._touches: Tensor | None = simulator.blocked if grounding.fails_at_walls else None
        keep_clear = getattr(innermost(simulator), "keep_clear", None)
        if keep_clear and grounding.clearance_m is not None:
            keep_clear(grounding.clearance_m)
        self.model, self.failures, self.scatter_model = grounding.model, grounding.failures, grounding.scatter_model
        shape, (count, _), device = self.model.shape, simulator.state.shape, simulator.state.device
        self.latent_size = shape.latent_size
        self.hidden = self.model.encoder.initial(count)
        self.goal = torch.zeros(count, shape.goal_size, device=device)
        self._last = self.latent, torch.zeros(count, shape.action_size, device=device)
        self._remembered = torch.zeros(count, self.failures.memory_size if self.failures else 0, device=device)

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
        """Start as `EpisodeSimulator` does; after `hidden` may come the averages of the failure model."""
        super().start(state, rows, goal)
        if self._touches is not None:
            self._touches = self._touches.index_fill(0, rows, False)
        self.goal[rows] = goal
        if previous_action is None:
            previous_action = torch.zeros(len(state), self.model.shape.action_size, device=state.device)
        if hidden is None:
            hidden = self.model.encoder.initial(len(state))
        hidden, averages = hidden.tensor_split([self.hidden.shape[1]], dim=-1)
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
            seen, self._remembered = self.failures.inputs(before, action, landed, latent, self._remembered)
            self.hazard = self.failures.hazard(self.failures.probability(seen))
        inputs = self.model.correction_inputs(latent, action, landed)
        state = corrected = self.model.corrected(inputs, landed)
        if self._touches is not None or self.scatter_model is None:
            state = self._settle(before, corrected)
            self._touches = None if self._touches is None else self.simulator.blocked
        if self.scatter_model is not None:
            state = self._settle(before, state + self.model.changed(inputs, self.scatter_model.draw(inputs)))
        self.hidden = self._encoded(state, self.goal, action, self.hidden)
        return state

    def _encoded(self, state: Tensor, goal: Tensor, previous_action: Tensor, hidden: Tensor) -> Tensor:
        """Return the encoder's memory (n, M) after one more step."""
        return self.model.encoder.step(self.model.encoder_input(state, goal, previous_action), hidden)

    @torch.no_grad()
    def predicted_reward(self, own: Tensor) -> Tensor:
        """Return the target's reward (B,) of the last step, by R_pred; see `EpisodeSimulator`."""
        latent, action = self._last
        return self.model.target_reward(latent, action, own, self.hazard)

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


@dataclass(frozen=True)
class HistoryGrounding(FittedGrounding):
    """Correct each step by a history model, whose latents policies observe."""

    kind: ClassVar[str] = "history"

    model: GroundingModel
    failures: FailureModel | None = None
    clearance_m: float | None = None  # of corrections from walls; None for as close as the simulator itself
    scatter_model: ScatterModel | None = None  # of the target around the correction, if one was fitted
    fails_at_walls: bool = False
    """Whether touching a wall is a failure. Then the correction touches it, not the scatter, which holds the
    errors of where the robot was believed to be."""

    @property
    def encoder(self) -> GroundingModel:
        """The model, whose encoder is ψ^s."""
        return self.model

    def for_replay(self) -> "HistoryGrounding":
        """Return the model alone."""
        return replace(self, failures=None, scatter_model=None)

    def corrected(self, simulator: PlacedSimulator) -> GroundedSimulator:
        """Wrap `simulator`; see `Grounding.corrected`."""
        return GroundedSimulator(simulator, self)

    @torch.no_grad()
    def hidden_before(self, windows: PairedWindows, every: int = 1) -> Tensor:
        """Return the encoder's memory before each `every`-th step, (E, ceil(T / every), M)."""
        _, after = self.model.encode(windows)
        before = self.model.encoder.initial(len(after)).unsqueeze(1)
        return torch.cat([before, after[:, :-1]], dim=1)[:, ::every]

    def to_file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return weights and sizes."""
        tensors = self.model.state_dict()
        metadata: dict[str, Any] = {"shape": asdict(self.model.shape), "fails_at_walls": self.fails_at_walls}
        for part, model in ((_FAILURES, self.failures), (_SCATTER, self.scatter_model)):
            if model is not None:
                tensors |= as_part(model.state_dict(), part)
                metadata[part] = asdict(model.shape)
        if self.clearance_m is not None:
            metadata["clearance_m"] = self.clearance_m
        return tensors, metadata

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        """Read what `to_file` returned."""
        parts = {_FAILURES: (FailureModel, FailureShape), _SCATTER: (ScatterModel, ScatterShape)}
        own = {name: one for name, one in tensors.items() if not name.startswith(tuple(f"{part}." for part in parts))}
        read: dict[str, Any] = {
            part: loaded(made(of_json(shape, metadata[part])), part_of(tensors, part), device)
            for part, (made, shape) in parts.items()
            if part in metadata
        }
        model = loaded(GroundingModel(of_json(GroundingShape, metadata["shape"])), own, device)
        clearance_m, fails_at_walls = metadata.get("clearance_m"), metadata["fails_at_walls"]
        return cls(model, read.get(_FAILURES), clearance_m, read.get(_SCATTER), fails_at_walls)
