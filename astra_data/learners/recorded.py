"""Recorded episodes as a policy would have seen them, to learn from in windows."""

from dataclasses import dataclass

import torch
from torch import Tensor

from astra_data.dataset.pairs import draw_steps


@dataclass(frozen=True)
class Recorded:
    """E recorded episodes of up to T steps, padded at the end.

    Attributes:
        observation: (E, T, O). previous_action: (E, T, A), zero at the start. action: (E, T, A).
        lengths: the number of real steps of each episode, (E,).
    """

    observation: Tensor
    previous_action: Tensor
    action: Tensor
    lengths: Tensor

    def windows(self, count: int, length: int, burn_in: int) -> tuple[dict[str, Tensor], Tensor]:
        """Draw windows of `length` steps by torch's global generator.

        Returns:
            the columns by name, (count, length, ...), and which steps to learn from, (count, length) bool:
            all but the first `burn_in` of a window that begins in the midst of its episode.
        """
        episodes, steps, learned = draw_steps(self.lengths, count, length)
        learned &= steps < self.lengths[episodes]
        learned &= (torch.arange(steps.shape[1], device=steps.device) >= burn_in) | (steps[:, :1] == 0)
        names = ("observation", "previous_action", "action")
        return {name: getattr(self, name)[episodes, steps] for name in names}, learned
