"""Outcomes of N episodes that are run side by side."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Outcome:
    """Outcomes of N episodes: a list per quantity, and every path.

    Attributes:
        success: 1 or 0.
        failed: 1 or 0.
        wall_contact: share of the steps.
        steps: until the end.
        returns: sum of rewards.
        position: of what moves, (N, T + 1, 2 K) in m, from the start on, NaN after the end.
    """

    success: list[float]
    failed: list[float]
    wall_contact: list[float]
    steps: list[int]
    returns: list[float]
    position: Tensor

    def to_json(self) -> dict[str, list[float]]:
        """Return the lists by name."""
        return {
            "success": self.success,
            "failed": self.failed,
            "wall_contact": self.wall_contact,
            "steps": [float(steps) for steps in self.steps],
            "return": self.returns,
        }


class EpisodeRecord:
    """Record N episodes until each has ended, in success or failure.

    Attributes:
        active: (N,) bool, not ended yet. total_steps: of all episodes together so far.
    """

    def __init__(self, position: Tensor) -> None:
        """Start at `position` (N, 2 K)."""
        count = len(position)
        self.active = torch.ones(count, dtype=torch.bool)
        self.total_steps = 0
        self._success, self._failed, self._contact, self._steps, self._return = torch.zeros(5, count)
        self._positions = [position.clone()]

    def add(self, position: Tensor, reward: Tensor, success: Tensor, failed: Tensor, contact: Tensor) -> None:
        """Add one step; rows of ended episodes are ignored."""
        active = self.active
        self._success += success & active
        self._failed += failed & active
        self._contact += contact & active
        self._steps += active
        self._return += torch.where(active, reward, 0.0)
        self._positions.append(torch.where(active.unsqueeze(-1), position, torch.nan))
        self.total_steps += int(active.sum())
        self.active = active & ~success & ~failed

    def outcome(self) -> Outcome:
        """Return the outcomes so far."""
        return Outcome(
            success=self._success.tolist(),
            failed=self._failed.tolist(),
            wall_contact=(self._contact / self._steps).tolist(),
            steps=self._steps.long().tolist(),
            returns=self._return.tolist(),
            position=torch.stack(self._positions, dim=1),
        )
