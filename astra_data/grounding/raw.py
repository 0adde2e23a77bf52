"""No grounding: the abstract simulator as it is."""

from dataclasses import dataclass

import torch
from torch import Tensor

from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding


@dataclass(frozen=True)
class NoGrounding(Grounding):
    """Leave the simulator as it is, except for varied parameters and scatter if given."""

    def scatter(self, episodes: PairedEpisodes) -> Tensor:
        """Return the factor (X, X) of the target's scatter around the raw simulator in `episodes`."""
        windows = episodes.windows
        return scatter_factor(episodes.steps(windows.next_state - windows.simulated_next))


NO_GROUNDING = NoGrounding()


def scatter_factor(residual: Tensor) -> Tensor:
    """Return the lower triangular factor (X, X) of the covariance of `residual` (N, X).

    Entries may depend on each other, as a velocity that is computed from positions does on these.
    """
    exact = residual.double()
    covariance = torch.cov(exact.T).view(exact.shape[1], -1) if len(exact) > 1 else exact.new_zeros(())
    least = 1e-9 * max(1.0, float(covariance.max()))
    eye = torch.eye(exact.shape[1], dtype=exact.dtype, device=exact.device)
    return torch.as_tensor(torch.linalg.cholesky(covariance + least * eye)).to(residual.dtype)
