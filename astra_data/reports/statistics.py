"""Statistics over a few seeds: mean and spread, interquartile mean, intervals, comparisons, correlations.

Follows "Deep reinforcement learning at the edge of the statistical precipice" (Agarwal et al., 2021) and
resamples with its library, rliable; what is computed of each resample is written out, since rliable's tests
of significance and SciPy's checks take most of a report's time. One score per seed and task, in one unit for
all tasks; resampling is over seeds, within each task.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError

REPLICATES = 2000
"""Bootstrap resamples per interval."""

CONFIDENCE = 0.95
"""Share of the resamples that lie inside an interval."""


@dataclass(frozen=True)
class Summary:
    """A row's score over its seeds.

    Attributes:
        mean: mean over seeds.
        std: sample standard deviation over seeds; None for a single seed.
        iqm: interquartile mean: the mean of the middle half of the seeds.
        low: lower end of the 95 % interval of `iqm`; None for a single seed.
        high: upper end of the 95 % interval of `iqm`; None for a single seed.
    """

    mean: float
    std: float | None
    iqm: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Difference:
    """How much higher one row's score is than another's, on the seeds that both have.

    Attributes:
        mean: over these seeds. low: lower end of its 95 % interval. high: upper end.
    """

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class Comparison:
    """The probability that a seed of one row beats a seed of another; ties count half.

    Attributes:
        probability: the estimate, in [0, 1].
        low: lower end of its 95 % interval; None where a row has a single seed.
        high: upper end of its 95 % interval; None where a row has a single seed.
        difference: of the rows, seed by seed; None where they share fewer than two seeds.
    """

    probability: float
    low: float | None
    high: float | None
    difference: Difference | None = None


@dataclass(frozen=True)
class Correlation:
    """A coefficient of correlation.

    Attributes:
        value: in [-1, 1]. low: lower end of its 95 % interval. high: upper end.
    """

    value: float
    low: float
    high: float


def summarize(scores: Floats, *, replicates: int = REPLICATES) -> Summary:
    """Summarize the `scores` (seeds,) or (seeds, tasks) of one row.

    Raises:
        BadInputError: there is no score, or one that is not finite.
    """
    matrix = _matrix(scores)
    mean, iqm = float(matrix.mean()), _interquartile_mean(matrix)
    if len(matrix) == 1:
        return Summary(mean, None, iqm, None, None)
    # Seeds are the unit of repetition, so tasks are averaged before the spread is taken.
    std = float(matrix.mean(axis=1).std(ddof=1))
    low, high = _interval(matrix, _interquartile_mean, replicates)
    return Summary(mean, std, iqm, low, high)


def probability_of_improvement(scores: Floats, others: Floats, *, replicates: int = REPLICATES) -> Comparison:
    """Estimate how likely a seed of `scores` (seeds,) or (seeds, tasks) beats one of `others` (same tasks).

    Raises:
        BadInputError: there is no score, or one that is not finite.
    """
    matrix, other_matrix = _matrix(scores), _matrix(others)
    probability = _share_of_wins(matrix, other_matrix)
    if min(len(matrix), len(other_matrix)) == 1:
        return Comparison(probability, None, None)
    low, high = _interval((matrix, other_matrix), _share_of_wins, replicates)
    return Comparison(probability, low, high)


def paired_difference(scores: Floats, others: Floats) -> Difference:
    """Return the mean difference of two scores (seeds,) on the same seeds, with its 95 % interval (Student).

    It takes two seeds or more. What a seed does to both cancels, so the interval is narrower than unpaired.
    """
    differences = scores - others
    mean, half = float(differences.mean()), _student(differences)
    return Difference(mean, mean - half, mean + half)


def correlation(
    first: Sequence[Floats], second: Sequence[Floats], *, ranks: bool = False, replicates: int = REPLICATES
) -> Correlation | None:
    """Correlate two scores over all seeds of some rows: Pearson's coefficient, or with `ranks` Spearman's.

    The seeds of a row are not independent, so the interval resamples rows, and seeds within each row.

    Args:
        first: one score, an array (seeds,) for each row.
        second: the other score, of the same shapes.
        ranks: correlate ranks (Spearman).
        replicates: bootstrap resamples.

    Returns:
        None where there are fewer than three seeds in all, or one side does not vary.
    """
    counts, rng = [len(scores) for scores in first], np.random.default_rng(0)
    begins = np.cumsum([0, *counts[:-1]])
    one, other = (np.concatenate(scores) for scores in (first, second))

    def resample() -> NDArray[np.intp]:
        rows = rng.integers(len(counts), size=len(counts))
        return np.concatenate([begins[row] + rng.integers(counts[row], size=counts[row]) for row in rows])

    value = float(_coefficients(one[None], other[None], ranks=ranks)[0])
    if len(one) < 3 or np.isnan(value):
        return None
    # Where rows differ in their number of seeds, so do resamples.
    by_size: dict[int, list[NDArray[np.intp]]] = {}
    for drawn in (resample() for _ in range(replicates)):
        by_size.setdefault(len(drawn), []).append(drawn)
    replicated = [
        _coefficients(one[np.array(drawn)], other[np.array(drawn)], ranks=ranks) for drawn in by_size.values()
    ]
    low, high = np.nanquantile(np.concatenate(replicated), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Correlation(value, float(low), float(high))


def _coefficients(one: Floats, other: Floats, *, ranks: bool) -> Floats:
    """Correlate each row of `one` (R, N) with that of `other`: (R,), not a number where one does not vary."""
    from scipy.stats import rankdata

    varies = (np.ptp(one, axis=1) > 0) & (np.ptp(other, axis=1) > 0)
    pair = [rankdata(side, axis=1) if ranks else side for side in (one, other)]
    one, other = (side - side.mean(axis=1, keepdims=True) for side in pair)
    products = np.sqrt((one**2).sum(axis=1) * (other**2).sum(axis=1))
    found = np.full(len(one), np.nan)
    np.divide((one * other).sum(axis=1), products, out=found, where=varies)
    return found


def mean_interval(shares: Sequence[float]) -> tuple[float, float]:
    """Return Student's 95 % interval of the mean of two shares or more, cut off at 0 and 1.

    For units as few as three to nine it covers the mean better than a bootstrap, which is too narrow there.
    """
    mean, half = float(np.mean(shares)), _student(shares)
    return max(mean - half, 0.0), min(mean + half, 1.0)


def _student(values: Sequence[float] | Floats) -> float:
    """Return half the width of Student's 95 % interval of the mean of two values or more."""
    from scipy.stats import t

    count = len(values)
    half = float(t.ppf((1 + CONFIDENCE) / 2, count - 1) * np.std(values, ddof=1))
    return half / math.sqrt(count)


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share: `count` of `total` episodes of one policy."""
    from scipy.stats import binomtest

    found = binomtest(count, total).proportion_ci(confidence_level=CONFIDENCE, method="wilson")
    return float(found.low), float(found.high)


def mean_rank_correlation(
    rows: Collection[Mapping[int, tuple[float, float]]], *, least: int, replicates: int = REPLICATES
) -> Correlation | None:
    """Correlate ranks (Spearman) within rows of `least` seeds or more, and take the mean over these rows.

    The seeds are resampled, the same for all rows, since rows share a seed's data.

    Args:
        rows: by seed, the two scores.
        least: seeds of a row that counts, also in a resample.
        replicates: bootstrap resamples.

    Returns:
        None where no row has enough seeds, or in none do both sides vary.
    """

    def of(seeds: Sequence[int]) -> float | None:
        sides = [np.array([row[seed] for seed in seeds if seed in row], dtype=np.float64).T for row in rows]
        found = [
            float(_coefficients(one[None], other[None], ranks=True)[0])
            for one, other in (pair for pair in sides if pair.size >= 2 * least)
        ]
        known = [value for value in found if not np.isnan(value)]
        return float(np.mean(known)) if known else None

    rng, seeds = np.random.default_rng(0), sorted({seed for row in rows for seed in row})
    value = of(seeds)
    if value is None:
        return None
    drawn = (of(rng.choice(seeds, size=len(seeds)).tolist()) for _ in range(replicates))
    replicated = [again for again in drawn if again is not None] or [value]
    low, high = np.quantile(replicated, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Correlation(value, float(low), float(high))


def _matrix(scores: Floats) -> Floats:
    if scores.size == 0 or not np.isfinite(scores).all():
        raise BadInputError(f"expected one finite score per seed, got {scores.tolist()}")
    return scores.astype(np.float64).reshape(len(scores), -1)


def _interquartile_mean(scores: Floats) -> float:
    """Return the mean of the middle half of the scores (seeds, tasks)."""
    quarter, count = scores.size // 4, scores.size
    middle = np.partition(scores.ravel(), (quarter, count - quarter - 1))[quarter : count - quarter]
    return float(middle.mean())


def _share_of_wins(scores: Floats, others: Floats) -> float:
    """Return the share of pairs of seeds where that of `scores` (seeds, tasks) is above; ties count half."""
    above = np.sign(scores[:, None] - others)
    return float((above + 1).mean((0, 1)).mean() / 2)


def _interval(
    scores: Floats | tuple[Floats, Floats], statistic: Callable[..., float], replicates: int
) -> tuple[float, float]:
    from rliable import library  # type: ignore[import-untyped]

    def as_array(*samples: Floats) -> Floats:
        return np.array([statistic(*samples)])

    with _fixed_global_seed():
        _, intervals = library.get_interval_estimates(
            {"row": scores}, as_array, reps=replicates, confidence_interval_size=CONFIDENCE
        )
    low, high = intervals["row"].ravel()
    return float(low), float(high)


@contextmanager
def _fixed_global_seed() -> Iterator[None]:
    # rliable draws from numpy's global generator whatever `random_state` it is given.
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)
