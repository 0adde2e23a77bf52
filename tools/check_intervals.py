"""Check choices without the target: regrets, coverage of intervals with trials, and trials that predictions save.

    uv run python tools/check_intervals.py RUN [RUN ...]

Every policy of a run makes 100 episodes in its target, and is judged from the same starts; trials are resampled from
these, 300 times. Saved: against the trials that an interval of trials alone needs for the same mean width.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.seeding import derive
from astra_data.pipeline.selecting import asked_of, select
from astra_data.pipeline.stages.select import predicted_from
from astra_data.pipeline.trained_policy import trained_policy
from astra_data.policies.episodes import in_target, started
from astra_data.policies.running_policy import RunningPolicy
from astra_data.reports.statistics import Estimate, success_rate

STARTS, REPEATS, TRIALS, ALONE = 100, 300, (10, 20, 50), range(10, 151, 5)
Values = NDArray[np.float64]


def outcomes(run: Path) -> list[tuple[Values, Values, int]]:
    """Return each policy's success (100,), predictions for the same starts, and how many episodes judged it."""
    (recipe, config), found = asked_of(run), []
    for one in (judged := select(run)).candidates:
        policy, first = trained_policy(run, one.row, seed=one.seed).running(), list[Tensor]()
        outcome = in_target(policy.task, partial(_begun, policy, first), STARTS, derive(one.seed, "check"))
        success, predicted = np.array(outcome.success), np.array(predicted_from(recipe, config, one, *first, root=run))
        found.append((success, predicted, judged.episodes * len(one.success)))
        print(f"{run.name}: {one.name}: {success.mean():.2f}, predicted {predicted.mean():.2f}", flush=True)
    return found


def _begun(policy: RunningPolicy, first: list[Tensor], goal: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """Start a policy, which leaves in `first` the abstract states that it starts from, and the goals."""
    act = started(policy, policy.act, goal)

    def acting(state: Tensor, goal: Tensor) -> Tensor:
        first.extend([] if first else [policy.task.abstraction(state), goal.clone()])
        return act(state, goal)

    return acting


def resampled(success: Values, predicted: Values | None, episodes: int, trials: int) -> tuple[float, float]:
    """Return coverage and mean width of a policy's intervals."""
    rng, ends = np.random.default_rng(trials), list[Estimate]()
    for _ in range(REPEATS):
        drawn = rng.integers(STARTS, size=trials)
        if predicted is None:
            ends.append(success_rate([*success[drawn]], [], 0.0, episodes))
        else:
            mean = float((rng.random(episodes) < predicted[rng.integers(STARTS, size=episodes)]).mean())
            ends.append(success_rate([*success[drawn]], [*predicted[drawn]], mean, episodes))
    low, high = np.array([[one.low, one.high] for one in ends]).T
    return float(np.mean((low <= success.mean()) & (success.mean() <= high))), float(np.mean(high - low))


def main(*runs: str) -> None:
    """Print a line for each run and number of trials."""
    for run in map(Path, runs):
        policies = outcomes(run)
        success, predicted = np.array([[of.mean() for of in one[:2]] for one in policies]).T
        print(
            f"{run.name}: the best predicted {success[predicted.argmax()]:.2f}, the best {success.max():.2f}, "
            f"all {success.mean():.2f}"
        )
        alone = [np.mean([resampled(success, None, 1, n)[1] for success, _, _ in policies]) for n in ALONE]
        for trials in TRIALS:
            found = np.array([resampled(*policy, trials) for policy in policies])
            needed = np.interp(-found[:, 1].mean(), -np.array(alone), ALONE)
            print(
                f"{run.name}: {trials} trials of {len(policies)} policies: coverage {found[:, 0].mean():.3f} (least "
                f"{found[:, 0].min():.3f}), width {found[:, 1].mean():.3f}, {100 * (1 - trials / needed):.0f} % saved",
                flush=True,
            )


if __name__ == "__main__":
    main(*sys.argv[1:])
