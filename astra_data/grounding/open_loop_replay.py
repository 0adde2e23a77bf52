"""Recorded actions replayed open loop from the start of each episode, to be looked at."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from astra_data.core.seeding import derive
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.moments import Moments
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding
from astra_data.worlds.task import Task


@dataclass(frozen=True)
class OpenLoopReplay:
    """E episodes of at most T steps in a simulator, by recorded actions; what comes after an episode is void.

    Attributes:
        state: φ(s_0), and where each step ended, (E, T + 1, X).
        hazard: the probability of a failure in each step, (E, T), by the failure model; None without one.
        disagreement: of the ensemble on each step, (E, T), see `EpisodeSimulator`; None where only one model
            with one head corrects.
    """

    state: Tensor
    hazard: Tensor | None = None
    disagreement: Tensor | None = None


@torch.no_grad()
def replay_open_loop(
    task: Task, grounding: Grounding, episodes: PairedEpisodes, *, seed: int
) -> OpenLoopReplay:
    """Replay whole `episodes` in the simulator of `task` as `grounding` corrects it.

    The model alone corrects, as in `gap_report`; hazards are those of replays that are scattered, if the
    grounding does so. Where there are members, each replays the episodes by itself too, and the disagreement
    is the mean over them.
    """
    history = grounding if isinstance(grounding, HistoryGrounding) else None
    state, hazard, disagreement = _replayed(task, grounding.for_replay(), episodes, seed=seed)
    if history is None:
        is_ensemble = bool(disagreement.any())
    else:
        foreseeing = history.foreseeing(task.objective).reduced(members=False, failures=True)
        hazard = None if history.failures is None else _replayed(task, foreseeing, episodes, seed=seed)[1]
        is_ensemble = bool(history.members) or history.model.shape.correction_heads > 1
        if count := len(history.members):
            members = replace(history, failures=None, scatter_model=None)
            apart = _replayed(task, members, episodes, seed=seed, copies=count)[2]
            disagreement = apart.unflatten(0, (count, len(episodes))).mean(0)
    return OpenLoopReplay(state, hazard, disagreement if is_ensemble else None)


def _replayed(
    task: Task, grounding: Grounding, episodes: PairedEpisodes, *, seed: int, copies: int = 1
) -> tuple[Tensor, Tensor | None, Tensor]:
    """Replay `copies` of all episodes, one after another, N in all.

    Returns:
        states (N, T + 1, X); risks of a failure (N, T), None where nothing tells them; disagreement (N, T).
    """
    windows, device = episodes.windows, str(episodes.windows.state.device)
    torch.manual_seed(derive(seed, "open-loop replay"))
    episode = torch.arange(len(episodes), device=device).repeat(copies)
    moments = Moments(windows, episode, torch.zeros_like(episode))
    simulator = grounding.simulator(task, len(moments), device)
    moments.start(simulator, None)
    states, risks, apart = [moments.state], [], []
    for step in range(windows.mask.shape[1]):
        states.append(simulator.step(moments.action(step)))
        if (risk := simulator.failure_risk()) is not None:
            risks.append(risk)
        apart.append(simulator.disagreement)
    return torch.stack(states, dim=1), torch.stack(risks, dim=1) if risks else None, torch.stack(apart, dim=1)
