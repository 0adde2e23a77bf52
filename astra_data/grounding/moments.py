"""Moments of recorded episodes, from which their commands are replayed in simulators."""

from dataclasses import dataclass

import torch
from torch import Tensor

from astra_data.grounding.networks.paired_windows import PairedWindows
from astra_data.grounding.simulator import EpisodeSimulator


@dataclass(frozen=True)
class Moments:
    """N moments of the episodes in `windows` (E, T, ...): step `first` (N,) of `episode` (N,)."""

    windows: PairedWindows
    episode: Tensor
    first: Tensor

    @classmethod
    def every(cls, windows: PairedWindows, steps: int) -> "Moments":
        """Return every so many `steps` of whole episodes."""
        episode, number = windows.mask[:, ::steps].nonzero(as_tuple=True)
        return cls(windows, episode, number * steps)

    def __len__(self) -> int:
        """Return their number N."""
        return len(self.first)

    @property
    def state(self) -> Tensor:
        """φ(s_i), (N, X)."""
        return self.windows.state[self.episode, self.first]

    @property
    def previous_action(self) -> Tensor:
        """a_{i-1}, (N, A)."""
        return self.windows.previous_action[self.episode, self.first]

    def start(self, simulator: EpisodeSimulator, hidden: Tensor | None) -> None:
        """Start a row of `simulator` at each, with what a grounding remembers of the history, (N, H)."""
        simulator.start(
            self.state,
            torch.arange(len(self), device=self.first.device),
            self.windows.goal[self.episode, self.first],
            hidden=hidden,
            previous_action=self.previous_action,
        )

    def action(self, count: int) -> Tensor:
        """Return the commands (N, A) of the steps that come `count` later."""
        return self.windows.action[self.episode, self.after(count)]

    def after(self, count: int) -> Tensor:
        """Return the steps (N,) that come `count` later; the last of T where there is none."""
        return (self.first + count).clamp_max(self.windows.mask.shape[1] - 1)
