"""Recorded actions replayed open loop from the start of each episode, to be looked at."""

import torch
from torch import Tensor

from astra_data.core.seeding import derive
from astra_data.grounding.moments import Moments
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding
from astra_data.worlds.task import Task


@torch.no_grad()
def replay_open_loop(task: Task, grounding: Grounding, episodes: PairedEpisodes, *, seed: int) -> Tensor:
    """Replay whole `episodes` in the simulator of `task` as `grounding` corrects it, without scatter.

    Returns:
        φ(s_0) and where each of T steps ended, (E, T + 1, X); what comes after an episode is void.
    """
    windows, device = episodes.windows, str(episodes.windows.state.device)
    torch.manual_seed(derive(seed, "open-loop replay"))
    episode = torch.arange(len(episodes), device=device)
    moments = Moments(windows, episode, torch.zeros_like(episode))
    simulator = grounding.for_replay().simulator(task, len(moments), device)
    moments.start(simulator, None)
    states = [moments.state]
    states += [simulator.step(moments.action(step)) for step in range(windows.mask.shape[1])]
    return torch.stack(states, dim=1)
