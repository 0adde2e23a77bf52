"""Recorded episodes as a policy would have seen them, drawn as windows of consecutive steps."""

from dataclasses import dataclass

import torch
from torch import Tensor


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

    def draw(self, count: int, length: int, burn_in: int) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Draw windows of `length` steps from torch's global generator.

        Returns:
            their places in the columns, episodes (count, 1) and steps (count, length), and which steps to
            learn from, (count, length) bool: all but the first `burn_in` of a window that begins within its
            episode.
        """
        episodes, steps, learned = draw_steps(self.lengths, count, length)
        learned &= steps < self.lengths[episodes]
        learned &= (torch.arange(steps.shape[1], device=steps.device) >= burn_in) | (steps[:, :1] == 0)
        return (episodes, steps), learned

    def windows(self, count: int, length: int, burn_in: int) -> tuple[dict[str, Tensor], Tensor]:
        """Draw windows as `draw` does.

        Returns:
            the columns by name, (count, length, ...), and which steps to learn from, (count, length) bool.
        """
        places, learned = self.draw(count, length, burn_in)
        names = ("observation", "previous_action", "action")
        return {name: getattr(self, name)[places] for name in names}, learned


def draw_steps(lengths: Tensor, count: int, length: int) -> tuple[Tensor, Tensor, Tensor]:
    """Draw windows of `length` steps, each step equally likely; from torch's global generator.

    A window that is drawn across an end of its episode is shifted inside. Otherwise the last steps, where
    robots fall, would hardly be seen.

    Args:
        lengths: of the episodes, (E,).
        count: of windows.
        length: of each window; at most the longest episode's.

    Returns:
        episodes (count, 1) and steps (count, length) of the windows, and which steps were drawn before the
        shift, (count, length) bool. In episodes shorter than `length` some lie beyond the end.
    """
    length = min(length, int(lengths.max()))
    beginnings = lengths + length - 1
    episodes = torch.multinomial(beginnings.float(), count, replacement=True)
    drawn = (torch.rand(count, device=episodes.device) * beginnings[episodes]).long() - (length - 1)
    first = drawn.clamp_min(0).minimum((lengths[episodes] - length).clamp_min(0))
    steps = first[:, None] + torch.arange(length, device=first.device)
    return episodes[:, None], steps, (steps >= drawn[:, None]) & (steps < drawn[:, None] + length)
