"""Fit the scatter model: to what a correction leaves unexplained of recorded steps."""

from typing import Any

import torch
from torch import Tensor

from astra_data.core.seeding import derive
from astra_data.grounding.descent import Descent, DescentConfig
from astra_data.grounding.networks.grounding import GroundingModel
from astra_data.grounding.networks.scatter import ScatterModel, ScatterShape
from astra_data.grounding.paired_episodes import PairedEpisodes

_DESCENT = DescentConfig(updates=1000, learning_rate=1e-3)
_BATCH = 2048
_MOST_FORMS = 20_000


def fit_scatter(
    model: GroundingModel, training: PairedEpisodes, held_out: PairedEpisodes, seed: int
) -> tuple[ScatterModel, dict[str, Any]]:
    """Fit scales to the residuals of the training episodes; take the forms from held-out ones.

    Returns:
        the scatter model, and its figures on held-out steps, of the entries that scatter: "gain_nats", of the
        log-likelihood of a step over scatter of one size; "kurtosis", of the forms, 3 for a Gaussian, None
        where nothing scatters.
    """
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
