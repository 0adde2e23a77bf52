"""Open-loop error: how far the raw and the grounded simulator drift from the target under its own actions."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Ints
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.core.seeding import derive, generator
from astra_data.grounding.paired_episodes import PairedEpisodes, PairedWindows
from astra_data.grounding.simulator import NO_GROUNDING, EpisodeSimulator, Grounding
from astra_data.worlds.task import Task

HORIZONS = (1, 10, 50, 200)
_START_EVERY = 25  # steps of an episode for each replay; one start is drawn from each part of this length


def distances(task: Task, error: Tensor) -> Tensor:
    """Return the norms (..., Q) of errors (..., X) of abstract states in each of the task's quantities."""
    return torch.stack([error[..., list(entries)].norm(dim=-1) for entries in task.quantities.values()], -1)


@without_gradients
def gap_report(task: Task, grounding: Grounding, episodes: PairedEpisodes, *, seed: int) -> dict[str, Any]:
    """Replay recorded actions open loop in both simulators; return errors of 1 to 200 steps, with intervals."""
    torch.manual_seed(derive(seed, "gap noise"))
    windows, lengths = episodes.windows, episodes.lengths.cpu().numpy()
    device, drawing = windows.state.device, generator(seed, "gap starts")
    horizons = [horizon for horizon in HORIZONS if horizon <= lengths.max()]
    groundings = {"raw": NO_GROUNDING, "grounded": grounding.for_replay()}
    hidden = {name: one.hidden_before(windows) for name, one in groundings.items()}
    errors: dict[str, dict[int, Tensor]] = {name: {} for name in (*groundings, "still")}
    started: dict[int, Tensor] = {}
    for horizon in horizons:
        episode, first = (torch.from_numpy(one).to(device) for one in _starts(lengths, horizon, drawing))
        moments, started[horizon] = Moments(windows, episode, first), episode
        states = {"still": moments.state}
        for name, one in groundings.items():
            simulator, before = one.simulator(task, len(moments), str(device)), hidden[name]
            moments.start(simulator, None if before is None else before[episode, first])
            for step in range(horizon):
                states[name] = simulator.step(moments.action(step))
        for name, state in states.items():
            apart = distances(task, state - windows.next_state[episode, moments.after(horizon - 1)])
            if not apart.isfinite().all():
                fault = f"its states are not finite in step {horizon} of recorded commands"
                raise BadInputError(f"the {name} simulator of {task.name} diverges: {fault}: bound them in its `step`")
            errors[name][horizon] = apart
    rng = generator(seed, "gap bootstrap")
    report: dict[str, Any] = {"horizons": horizons, "replays": len(started[horizons[0]])}
    for name, by_horizon in errors.items():
        report[name] = {}
        for index, quantity in enumerate(task.quantities):
            intervals = [_interval(by_horizon[h][:, index], started[h], rng) for h in horizons]
            report[name][quantity] = dict(zip(("mean", "low", "high"), zip(*intervals, strict=True), strict=True))
    return report


def _starts(lengths: Ints, horizon: int, rng: np.random.Generator) -> tuple[Ints, Ints]:
    """Draw episode and first step, (N,) each, of replays of `horizon` steps: one in each `_START_EVERY` starts."""
    possible = np.maximum(lengths - horizon + 1, 0)
    counts = -(-possible // _START_EVERY)
    episode = np.repeat(np.arange(len(lengths)), counts)
    part = np.arange(len(episode)) - np.repeat(counts.cumsum() - counts, counts)
    share = (part + rng.random(len(episode))) / counts[episode]
    return episode, (share * possible[episode]).astype(np.int64)


def _interval(errors: Tensor, episode: Tensor, rng: np.random.Generator) -> tuple[float, float | None, float | None]:
    """Return the mean of `errors` (N,) and its 95 % bootstrap interval, resampling episodes (N,)."""
    values, groups = errors.cpu().numpy(), episode.cpu().numpy()
    counts, sums = np.bincount(groups), np.bincount(groups, values)
    present, mean = np.flatnonzero(counts), float(sums.sum() / counts.sum())
    if len(present) == 1:
        return mean, None, None
    drawn: NDArray[np.intp] = rng.choice(present, (1000, len(present)))
    means = sums[drawn].sum(1) / counts[drawn].sum(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return mean, float(low), float(high)


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
        rows, goal = torch.arange(len(self), device=self.first.device), self.windows.goal[self.episode, self.first]
        simulator.start(self.state, rows, goal, hidden=hidden, previous_action=self.previous_action)

    def action(self, count: int) -> Tensor:
        """Return the commands (N, A) of the steps that come `count` later."""
        return self.windows.action[self.episode, self.after(count)]

    def after(self, count: int) -> Tensor:
        """Return the steps (N,) that come `count` later; the last of T where there is none."""
        return (self.first + count).clamp_max(self.windows.mask.shape[1] - 1)


@without_gradients
def replay_open_loop(task: Task, grounding: Grounding, episodes: PairedEpisodes, *, seed: int) -> Tensor:
    """Replay whole `episodes` as `grounding` corrects them, without scatter; return states (E, T + 1, X)."""
    windows, device = episodes.windows, str(episodes.windows.state.device)
    torch.manual_seed(derive(seed, "open-loop replay"))
    episode = torch.arange(len(episodes), device=device)
    moments = Moments(windows, episode, torch.zeros_like(episode))
    simulator = grounding.for_replay().simulator(task, len(moments), device)
    moments.start(simulator, None)
    states = [moments.state]
    states += [simulator.step(moments.action(step)) for step in range(windows.mask.shape[1])]
    return torch.stack(states, dim=1)
