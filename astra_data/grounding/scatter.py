"""What a correction leaves unexplained, such as where in its gait a robot is: its size at a moment, and its forms."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from astra_data.core.seeding import derive
from astra_data.grounding.descent import Descent, DescentConfig
from astra_data.grounding.encoder import mlp
from astra_data.grounding.model import GroundingModel
from astra_data.grounding.paired_episodes import PairedEpisodes

_MOST = 2.0  # of the logarithm of a scale: off the data no moment shall scatter by more than e² times the usual


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
        # An untrained network says that every moment is usual.
        for parameter in list(self.network.parameters())[-2:]:
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


_DESCENT = DescentConfig(updates=500, learning_rate=2e-3)
_BATCH = 2048
_MOST_FORMS = 20_000


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
    return scatters, {
        "gain_nats": float(gains[scattered].sum()),
        "kurtosis": float(kurtosis[scattered].mean()) if scattered.any() else None,
    }


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
