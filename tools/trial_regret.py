"""How much trials improve a choice, by replaying the target episodes of the policies in a report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.reports.halving import halve
from astra_data.reports.schema import Results
from astra_data.reports.statistics import CONFIDENCE


@dataclass(frozen=True)
class Pool:
    """A candidate: what ranks it, and how many of its target episodes succeeded.

    Attributes:
        seed: of its policy. lower: quartile of its judges. predicted: their mean.
        episodes: in the target. successes: of these.
    """

    seed: int
    lower: float
    predicted: float
    episodes: int
    successes: int

    @property
    def success(self) -> float:
        """The share of its episodes, taken for the truth."""
        return self.successes / self.episodes


@dataclass(frozen=True)
class Estimate:
    """A mean regret, and its 95 % interval, which resamples the seeds."""

    mean: float
    low: float
    high: float


Choose = Callable[[Sequence[Pool], int, np.random.Generator], int]
"""Given pools, the most preferred first, and so many trials, returns which is chosen."""


class _Deck:
    """Draws from a pool without replacement, and from all of it again once it is used up."""

    def __init__(self, pool: Pool, rng: np.random.Generator) -> None:
        self._pool, self._rng = pool, rng
        self._good, self._bad = pool.successes, pool.episodes - pool.successes

    def draw(self, count: int) -> int:
        """Return how many of so many episodes succeed."""
        found = 0
        while count >= self._good + self._bad:
            found, count = found + self._good, count - self._good - self._bad
            self._good, self._bad = self._pool.successes, self._pool.episodes - self._pool.successes
        drawn = int(self._rng.hypergeometric(self._good, self._bad, count)) if count else 0
        self._good, self._bad = self._good - drawn, self._bad - (count - drawn)
        return found + drawn


def by_halving(pools: Sequence[Pool], trials: int, rng: np.random.Generator) -> int:
    """Choose as `select --trials` does."""
    decks = [_Deck(pool, rng) for pool in pools]

    def attempt(_: int, those: tuple[int, ...], each: int) -> list[int]:
        return [decks[one].draw(each) for one in those]

    return halve([pool.lower for pool in pools], trials, attempt).chosen


def by_equal_shares(pools: Sequence[Pool], trials: int, rng: np.random.Generator) -> int:
    """Try all alike and choose the most successful; with fewer trials than pools, some are tried once."""
    each, those = trials // len(pools), rng.permutation(len(pools))
    if each == 0:
        each, those = 1, those[: max(trials, 1)]
    reached = [_Deck(pools[one], rng).draw(each) for one in those]
    return int(those[int(np.argmax(reached))])


def at_random(pools: Sequence[Pool], trials: int, rng: np.random.Generator) -> int:
    """Choose without trying."""
    return int(rng.integers(len(pools)))


def mean_regret(
    pools: Sequence[Pool], trials: int, choose: Choose, *, repeats: int, rng: np.random.Generator
) -> float:
    """Return the success of the best less that of the chosen, a mean over repeats."""
    ranked = sorted(pools, key=lambda pool: (pool.lower, pool.predicted), reverse=True)
    best = max(pool.success for pool in ranked)
    return fmean(best - ranked[choose(ranked, trials, rng)].success for _ in range(repeats))


def estimate(
    pools: Sequence[Pool], trials: int, choose: Choose, *, repeats: int, resamples: int, seed: int = 0
) -> Estimate:
    """Return the mean regret over repeats, with an interval: each resample draws the seeds anew.

    Args:
        pools: the candidates.
        trials: to spend.
        choose: how.
        repeats: of the draw of the outcomes; a tenth of them for each resample.
        resamples: of the seeds.
        seed: of all draws.
    """
    rng, seeds = np.random.default_rng(seed), sorted({pool.seed for pool in pools})
    of = {one: [pool for pool in pools if pool.seed == one] for one in seeds}
    again = []
    for _ in range(resamples):
        drawn = [pool for one in rng.choice(seeds, size=len(seeds)) for pool in of[int(one)]]
        again.append(mean_regret(drawn, trials, choose, repeats=max(repeats // 10, 1), rng=rng))
    low, high = np.quantile(again, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    mean = mean_regret(pools, trials, choose, repeats=repeats, rng=rng)
    return Estimate(mean, float(low), float(high))


def pools_of(results: Results) -> list[Pool]:
    """Return the candidates of a choice that were tested in the target.

    Raises:
        BadInputError: there is no choice, or fewer than two of its candidates were tested in the target.
    """
    if results.choice is None:
        raise BadInputError(
            f"expected results with a choice, got those of {results.recipe} without: "
            "give the recipe a table [select] and run it"
        )
    pools = [
        Pool(one.seed, one.lower, one.predicted, results.episodes, round(one.target * results.episodes))
        for one in results.choice.candidates
        if one.target is not None
    ]
    if len(pools) < 2:
        raise BadInputError(
            f"{results.recipe}: expected two candidates or more that were tested in the target, found "
            f"{len(pools)}: run its recipe until evaluate"
        )
    return pools
