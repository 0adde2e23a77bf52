"""No grounding: the abstract simulator as it is."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.simulator import EpisodeSimulator, abstract_simulator
from astra_data.learning.networks.paired_windows import PairedWindows
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation


@dataclass(frozen=True)
class NoGrounding:
    """Leave the simulator as it is, except for varied parameters and scatter if given."""

    start_stride: ClassVar[int] = 1

    @property
    def encoder(self) -> None:
        """There are no latents."""

    def simulator(
        self,
        task: Task,
        num_envs: int,
        device: str = "cpu",
        *,
        variation: Variation | None = None,
        scatter: Tensor | None = None,
    ) -> EpisodeSimulator:
        """Build `num_envs` simulators; see `Grounding.simulator`."""
        return EpisodeSimulator(abstract_simulator(task, num_envs, device, variation), scatter=scatter)

    def hidden_before(self, windows: PairedWindows, every: int = 1) -> None:
        """Return None: nothing is remembered."""

    def scatter(self, episodes: PairedEpisodes) -> Tensor:
        """Return the factor (X, X) of the target's scatter around the raw simulator in `episodes`."""
        windows = episodes.windows
        return scatter_factor(episodes.steps(windows.next_state - windows.simulated_next))

    def for_replay(self) -> "NoGrounding":
        """Return itself."""
        return self


NO_GROUNDING = NoGrounding()


def scatter_factor(residual: Tensor) -> Tensor:
    """Return the lower triangular factor (X, X) of the covariance of `residual` (N, X)."""
    covariance = torch.cov(residual.T) + 1e-9 * torch.eye(residual.shape[1], device=residual.device)
    return torch.as_tensor(torch.linalg.cholesky(covariance))
