"""Open-loop error: how far the raw and the grounded simulator drift from the target under its own actions."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive, generator
from astra_data.grounding.moments import Moments
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding
from astra_data.grounding.raw import NO_GROUNDING
from astra_data.worlds.task import Task

HORIZONS = (1, 10, 50, 200)
_START_EVERY = 25


def distances(task: Task, error: Tensor) -> Tensor:
    """Return the norms (..., Q) of errors (..., X) of abstract states in each of the task's quantities."""
    return torch.stack([error[..., list(entries)].norm(dim=-1) for entries in task.quantities.values()], -1)


@torch.no_grad()
def gap_report(task: Task, grounding: Grounding, episodes: PairedEpisodes, *, seed: int) -> dict[str, Any]:
    """Replay the actions of `episodes` open loop in both simulators and compare with the target.

    Beside them, under "still", is the error of who expects the robot to stay where it is.

    Replays start every 25 steps, with a grounding's memory of the true history up to there. Errors are
    distances in the task's quantities after 1, 10, 50 and 200 steps: means and 95 % bootstrap intervals over
    episodes; None where a single episode is that long.

    Raises:
        BadInputError: a simulator's states are not finite, though the recorded ones are.
    """
    torch.manual_seed(derive(seed, "gap noise"))
    windows, lengths = episodes.windows, episodes.lengths
    moments, device = Moments.every(windows, _START_EVERY), str(windows.state.device)
    episode, start = moments.episode, moments.first
    horizons = [horizon for horizon in HORIZONS if horizon <= int(lengths.max())]
    simulators = {}
    for name, one in {"raw": NO_GROUNDING, "grounded": grounding.for_replay()}.items():
        simulators[name] = one.simulator(task, len(moments), device)
        before = one.hidden_before(windows)
        moments.start(simulators[name], None if before is None else before[episode, start])
    errors: dict[str, dict[int, Tensor]] = {name: {} for name in (*simulators, "still")}
    for step in range(horizons[-1]):
        now = moments.after(step)
        action = windows.action[episode, now]
        states = {name: simulator.step(action) for name, simulator in simulators.items()}
        states["still"] = moments.state
        if step + 1 in horizons:
            for name, state in states.items():
                apart = distances(task, state - windows.next_state[episode, now])
                beyond = start + step >= lengths[episode]
                if not apart[~beyond].isfinite().all():
                    raise BadInputError(
                        f"the {name} simulator of {task.name} diverges: its states are not finite in step "
                        f"{step + 1} of recorded commands: bound them in its `step`"
                    )
                apart[beyond] = torch.nan
                errors[name][step + 1] = apart
    rng = generator(seed, "gap bootstrap")
    report: dict[str, Any] = {"horizons": horizons, "replays": len(moments)}
    for name, by_horizon in errors.items():
        report[name] = {}
        for index, quantity in enumerate(task.quantities):
            intervals = [_interval(by_horizon[h][:, index], episode, rng) for h in horizons]
            report[name][quantity] = dict(
                zip(("mean", "low", "high"), zip(*intervals, strict=True), strict=True)
            )
    return report


def _interval(
    errors: Tensor, episode: Tensor, rng: np.random.Generator
) -> tuple[float, float | None, float | None]:
    """Return the mean of `errors` (N,) and its 95 % bootstrap interval, resampling episodes (N,)."""
    values, groups = errors.cpu().numpy(), episode.cpu().numpy()
    keep = np.isfinite(values)
    counts = np.bincount(groups[keep])
    sums = np.bincount(groups[keep], values[keep])
    present, mean = np.flatnonzero(counts), float(sums.sum() / counts.sum())
    if len(present) == 1:
        return mean, None, None
    drawn: NDArray[np.intp] = rng.choice(present, (1000, len(present)))
    means = sums[drawn].sum(1) / counts[drawn].sum(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return mean, float(low), float(high)
