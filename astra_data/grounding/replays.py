"""Replays of short windows of recorded episodes, in simulators with given parameters."""

from dataclasses import dataclass

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.grounding.open_loop_error import distances
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.worlds.task import Task


@dataclass(frozen=True)
class ReplayWindows:
    """W windows of H steps of the target.

    Attributes:
        state: (W, X), and goal: (W, G), at their beginning. action: (W, H, A). next_state: (W, H, X).
    """

    state: Tensor
    goal: Tensor
    action: Tensor
    next_state: Tensor

    @classmethod
    def at(cls, episodes: PairedEpisodes, episode: Tensor, first: Tensor, length: int) -> "ReplayWindows":
        """Cut windows of `length` steps out of `episode` (W,) from step `first` (W,) on."""
        windows, steps = episodes.windows, first[:, None] + torch.arange(length, device=first.device)
        rows = episode[:, None], steps
        state, goal = windows.state[episode, first], windows.goal[episode, first]
        return cls(state, goal, windows.action[rows], windows.next_state[rows])

    @classmethod
    def side_by_side(cls, episodes: PairedEpisodes, length: int) -> "ReplayWindows":
        """Cut all episodes into windows of `length` steps that do not overlap."""
        episode, first = beginnings(episodes, length)
        chosen = first % length == 0
        return cls.at(episodes, episode[chosen], first[chosen], length)

    def summary(self, task: Task) -> Tensor:
        """Return a causal model's inputs of each window, (W, K), scaled to one: observation, mean command.

        In a maze that is the first state without its position.
        """
        known = self.state[:, 2:] if task.plane else task.objective.observe(self.state, self.goal)
        return torch.cat([known, self.action.mean(1)], dim=-1)


def beginnings(episodes: PairedEpisodes, length: int) -> tuple[Tensor, Tensor]:
    """Return the episode and the first step, (N,) each, of every window of `length` steps.

    Raises:
        BadInputError: no episode is that long.
    """
    steps = torch.arange(episodes.windows.mask.shape[1], device=episodes.lengths.device)
    begins = (steps <= (episodes.lengths - length)[:, None]).nonzero()
    if not len(begins):
        raise BadInputError(
            f"{episodes.reference}: expected episodes of at least {length} steps, the longest has "
            f"{int(episodes.lengths.max())}: shorten `window` in [compass]"
        )
    return begins[:, 0], begins[:, 1]


@torch.no_grad()
def trajectory_gaps(task: Task, recorded: ReplayWindows, parameters: Tensor, seed: int) -> Tensor:
    """Replay W windows with each of `parameters` (C, P) and the same noise; return their gaps (C, W, Q).

    A gap is the mean distance from the recorded states over a window, in each of the task's Q quantities.
    """
    count, length = recorded.action.shape[:2]
    simulator = task.varied_simulator(count, type(task.varied.wide)(), str(recorded.state.device))
    gaps = []
    for values in parameters:
        torch.manual_seed(seed)
        simulator.parameters = values.expand(count, -1)
        simulator.reset_to(recorded.state)
        wrong = [simulator.step(recorded.action[:, i]) - recorded.next_state[:, i] for i in range(length)]
        gaps.append(distances(task, torch.stack(wrong)).mean(0))
    return torch.stack(gaps)
