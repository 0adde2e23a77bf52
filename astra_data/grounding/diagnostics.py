"""How well a grounding predicts episodes that it was not fitted to."""

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.grounding.networks.grounding import GroundingModel, LossWeights, recorded_rewards
from astra_data.grounding.networks.paired_windows import PairedWindows
from astra_data.grounding.paired_episodes import PairedEpisodes


@torch.no_grad()
def telemetry(
    model: GroundingModel, episodes: PairedEpisodes, weights: LossWeights
) -> dict[str, float | None]:
    """Return figures that losses do not show, on `episodes`.

    They are: R² of each head that is trained (for the correction: the share of the simulator's error that it
    removes), None where there is no variance to explain, as in a perfect simulator; the mean standard
    deviation of the latent's entries; and the latent's effective rank (exponential of the entropy of the
    normalized eigenvalues of its covariance); both None for a single step.

    Raises:
        BadInputError: latents are not finite: the fit diverged.
    """
    windows = episodes.windows
    latent, _ = model.encode(windows)
    mask = windows.mask.bool()
    samples = latent[mask]
    if not samples.isfinite().all():
        raise BadInputError("the fit diverged: lower learning_rate in [ground], or look at the data's values")
    corrected = model.correct(latent, windows.action, windows.simulated_next)
    figures: dict[str, float | None] = {"r2_state": correction_r2(corrected, windows, model.correction_std)}
    if weights.reward > 0:
        known = windows.goes_on.bool() & mask
        predicted, true = model.rewards(latent, windows.action)[known], recorded_rewards(windows)[known]
        figures["r2_reward"] = _r2(predicted[:, 0], true[:, 0])
    if weights.latent > 0:
        mean, _ = model.predict_latent(latent[:, :-1], windows.action[:, :-1])
        both = mask[:, :-1] & mask[:, 1:]
        figures["r2_latent"] = _r2(mean[both], latent[:, 1:][both])
    figures["latent_std"] = figures["latent_rank"] = None
    if len(samples) < 2:
        return figures
    eigenvalues = torch.linalg.eigvalsh(torch.cov(samples.T)).clamp_min(1e-12)
    shares = eigenvalues / eigenvalues.sum()
    figures["latent_std"] = float(samples.std(0).mean())
    figures["latent_rank"] = float(torch.exp(-(shares * shares.log()).sum()))
    return figures


def correction_r2(corrected: Tensor, windows: PairedWindows, std: Tensor) -> float | None:
    """Return the share of the simulator's squared error, in units of `std` (X,), that a correction removes.

    `corrected` (B, T, X) are the corrected simulated next states of `windows`. None where the simulator makes
    no error.
    """
    mask = windows.mask.bool()
    wrong, raw = (
        ((landed - windows.next_state) / std)[mask].square().sum()
        for landed in (corrected, windows.simulated_next)
    )
    return _explained(wrong, raw)


def _r2(predicted: Tensor, true: Tensor) -> float | None:
    return _explained((predicted - true).square().sum(), (true - true.mean(0)).square().sum())


def _explained(residual: Tensor, total: Tensor) -> float | None:
    return float(1.0 - residual / total) if total > 0 else None
