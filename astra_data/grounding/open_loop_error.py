"""The gap report: how far raw and grounded simulator drift from the target under its own actions."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.seeding import derive, generator
from astra_data.grounding.build import hidden_before, simulator_of, start_simulator
from astra_data.grounding.grounding_file import Grounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation

HORIZONS = (1, 10, 50, 200)
_START_EVERY = 25


def distances(task: Task, wrong: Tensor) -> Tensor:
    """Return the length of errors (..., X) of abstract states in each of the task's quantities, (..., Q)."""
    return torch.stack([wrong[..., list(entries)].norm(dim=-1) for entries in task.quantities.values()], -1)


@torch.no_grad()
def gap_report(task: Task, grounding: Grounding, episodes: PairedEpisodes, *, seed: int) -> dict[str, Any]:
    """Replay the actions of `episodes` open loop in both simulators and compare with the target.

    Replays start every 25 steps, a grounding with a memory having seen the true history so far. Errors
    are distances in the task's quantities after 1, 10, 50 and 200 steps; means and 95 % bootstrap intervals
    over episodes.
    """
    torch.manual_seed(derive(seed, "gap noise"))
    windows = episodes.windows
    lengths = episodes.lengths
    pairs = [
        (episode, step)
        for episode, length in enumerate(lengths.tolist())
        for step in range(0, length, _START_EVERY)
    ]
    episode, start = torch.tensor(pairs, device=lengths.device).T
    if isinstance(grounding, Variation):
        # The noise of its sensors is no part of where a simulator goes.
        grounding = grounding.noiseless()
    before = hidden_before(grounding, windows)
    device = str(windows.state.device)
    horizons = [horizon for horizon in HORIZONS if horizon <= int(lengths.max())]
    raw = task.simulator(len(pairs), device)
    raw.reset_to(windows.state[episode, start])
    grounded = simulator_of(task, grounding, len(pairs), device)
    start_simulator(
        grounded,
        windows.state[episode, start],
        torch.arange(len(pairs), device=lengths.device),
        windows.goal[episode, start],
        hidden=None if before is None else before[episode, start],
        previous_action=windows.previous_action[episode, start],
    )
    errors: dict[str, dict[int, Tensor]] = {"raw": {}, "grounded": {}}
    for step in range(horizons[-1]):
        now = (start + step).clamp_max(windows.mask.shape[1] - 1)
        action = windows.action[episode, now]
        states = {"raw": raw.step(action), "grounded": grounded.step(action)}
        if step + 1 in horizons:
            for name, state in states.items():
                wrong = state - windows.next_state[episode, now]
                apart = distances(task, wrong)
                apart[start + step >= lengths[episode]] = torch.nan
                errors[name][step + 1] = apart
    rng = generator(seed, "gap bootstrap")
    report: dict[str, Any] = {"horizons": horizons, "replays": len(pairs)}
    for name, by_horizon in errors.items():
        report[name] = {}
        for index, quantity in enumerate(task.quantities):
            rows = [_interval(by_horizon[h][:, index], episode, rng) for h in horizons]
            report[name][quantity] = dict(zip(("mean", "low", "high"), zip(*rows, strict=True), strict=True))
    return report


def _interval(errors: Tensor, episode: Tensor, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return mean and 95 % bootstrap interval of `errors` (N,), resampling episodes (N,)."""
    values, groups = errors.cpu().numpy(), episode.cpu().numpy()
    keep = np.isfinite(values)
    counts = np.bincount(groups[keep])
    sums = np.bincount(groups[keep], values[keep])
    present = np.flatnonzero(counts)
    drawn: NDArray[np.intp] = rng.choice(present, (1000, len(present)))
    means = sums[drawn].sum(1) / counts[drawn].sum(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(sums.sum() / counts.sum()), float(low), float(high)
