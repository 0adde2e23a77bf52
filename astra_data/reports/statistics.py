"""Means, differences and correlations over a few seeds, with intervals.

Seeds are the unit of repetition. The interval of a mean of shares of episodes is the wider of two at each end:
Student's t, and Wilson's score interval with Student's quantile, in which the spread between seeds counts as if so many
episodes had been drawn at once. Student's t alone is too narrow near 0 and 1, where seeds are often equal by chance.
With 3 to 10 seeds of 120 episodes, it covers the mean of Beta-distributed seeds in 93 % of the cases or more. Below
three seeds there is no interval.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from statistics import NormalDist, fmean, linear_regression, pvariance

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError

REPLICATES = 2000  # bootstrap resamples per interval
CONFIDENCE = 0.95  # nominal coverage of an interval
LEAST_SEEDS = 3  # seeds below which no interval is given
_PSEUDO_TRIALS = 2  # as if in so many more, the prediction had said nothing: a few may agree with it by chance
_FEW = 3  # successes, or failures
_NORMAL = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)


@dataclass(frozen=True)
class Estimate:
    """A figure over `seeds` with the ends of its 95 % interval, None where there are too few; `std` is the sample's."""

    value: float
    low: float | None = None
    high: float | None = None
    std: float | None = None
    seeds: int = 0


def spread(found: Estimate | None, digits: int) -> str:
    """Return a mean ± its standard deviation; a dash for None."""
    if found is None:
        return "-"
    return f"{found.value:z.{digits}f}" + ("" if found.std is None else f" ± {found.std:.{digits}f}")


def ends(found: Estimate | None, digits: int = 2) -> str:
    """Return the interval of a figure; a dash where it has none."""
    if found is None or found.low is None or found.high is None:
        return "-"
    return f"[{found.low:z.{digits}f}, {found.high:z.{digits}f}]"


def interval(found: Estimate | None, digits: int = 2) -> str:
    """Return a figure and, if it has one, its interval; a dash for None."""
    return "-" if found is None else f"{found.value:z.{digits}f} {ends(found, digits)}".removesuffix(" -")


def summarize(scores: Sequence[float] | Floats, *, limit: float | None = None, trials: int = 0) -> Estimate:
    """Return the mean of values (N,), one per seed or judge, from 0 to `limit`; each a share of `trials` episodes."""
    values = np.asarray(scores, dtype=np.float64)
    if values.size == 0 or not np.isfinite(values).all():
        raise BadInputError(f"expected one finite score per seed, got {values.tolist()}")
    mean, count = float(values.mean()), len(values)
    if count < LEAST_SEEDS:
        return Estimate(mean, std=float(values.std(ddof=1)) if count > 1 else None, seeds=count)
    half = _student(count) * math.sqrt(_variance(values))
    low, high = mean - half, mean + half
    if trials:
        # Wilson's interval of as many episodes as spread like the seeds when drawn, as if there were one seed
        # more; at most all of them, and at least half an episode.
        drawn, variance = mean * (1 - mean), _variance(values) * (count + 1) / count
        episodes = min(max(drawn / variance if variance > 0 else math.inf, 0.5), count * trials)
        wider = _wilson(mean, _student(count) ** 2 / episodes)
        low, high = min(low, wider[0]), max(high, wider[1])
    if limit is not None:
        low, high = max(low, 0.0), min(high, limit)
    return Estimate(mean, low, high, float(values.std(ddof=1)), count)


def success_rate(success: Sequence[float], predicted: Sequence[float], mean: float, episodes: int) -> Estimate:
    """Return the rate of `success` (n,), 1 or 0, with an interval that predictions of the same trials make narrower.

    `predicted` (n,) are the trials' own, or none; `mean` is that of `episodes` more, from starts drawn alike. The
    control variate of PPI++: where trials began from easier starts than most, their rate is corrected by as much as the
    prediction explains, within the interval of the trials alone; the interval is Wilson's of as many trials as would
    vary as little as what it leaves.
    """
    count = len(success)
    if not count:
        return Estimate(mean, 0.0, 1.0)
    rate, slope, left = fmean(success), 0.0, 0.0
    value = rate
    if predicted and len({*success}) > 1 and len({*predicted}) > 1:
        slope = linear_regression(predicted, success).slope / (1 + count / episodes)
        slope = min(max(slope, 0.0), 1.0)
        low, high = _wilson(rate, _NORMAL**2 / count)
        value = min(max(rate + slope * (mean - fmean(predicted)), low), high)
    trials = float(count)
    if slope:
        whole = max(value * (1 - value), rate * (1 - rate))
        left = count * pvariance([one - slope * other for one, other in zip(success, predicted, strict=True)])
        left = (left + _PSEUDO_TRIALS * whole) / (count - 1 + _PSEUDO_TRIALS)
        trials *= whole / (left + slope**2 * mean * (1 - mean) * count / episodes)
    low, high = _wilson(value, _NORMAL**2 / trials)
    low, high = min(low, _least(value, trials)), max(high, 1.0 - _least(1.0 - value, trials))
    return Estimate(value, max(low, 0.0), min(high, 1.0))


def _least(rate: float, trials: float) -> float:
    """Return Poisson's lower bound of a rate of few successes, for which Wilson's covers too rarely; 1 for more."""
    from scipy.special import gammaincinv

    few = rate * trials
    return float(gammaincinv(few, 1 - CONFIDENCE)) / trials if 0 < few <= min(_FEW, trials / 4) else 1.0


def _wilson(mean: float, extra: float) -> tuple[float, float]:
    """Return the ends of Wilson's interval of a rate; `extra` is the quantile's square by the number of trials."""
    center = (mean + extra / 2) / (1 + extra)
    half = math.sqrt(mean * (1 - mean) * extra + extra**2 / 4) / (1 + extra)
    return center - half, center + half


def paired_difference(
    scores: Mapping[int, float], others: Mapping[int, float], *, limit: float | None = None, trials: int = 0
) -> Estimate | None:
    """Return the mean difference on the seeds that both have, with Student's t interval; None where there are none."""
    shared = [seed for seed in scores if seed in others]
    if not shared:
        return None
    sides = [np.array([of[seed] for seed in shared], dtype=np.float64) for of in (scores, others)]
    differences = sides[0] - sides[1]
    mean, count, drawn = float(differences.mean()), len(shared), 0.0
    if count < LEAST_SEEDS:
        return Estimate(mean)
    if trials:
        episodes = count * trials
        for side in sides:  # two successes and two failures are added
            near = (float(side.mean()) * episodes + 2) / (episodes + 4)
            drawn += near * (1 - near) / episodes
    half = _student(count) * math.sqrt(max(_variance(differences), drawn))
    bound = math.inf if limit is None else limit
    return Estimate(mean, max(mean - half, -bound), min(mean + half, bound))


def probability_of_improvement(scores: Floats, others: Floats) -> Estimate | None:
    """Estimate how likely a seed of `scores` beats one of `others`, with a bootstrap over seeds; ties count half."""
    if min(len(scores), len(others)) < LEAST_SEEDS:
        return None
    from scipy.stats import bootstrap

    def share_of_wins(one: Floats, other: Floats, axis: int = -1) -> Floats:
        return np.asarray((np.sign(one[..., :, None] - other[..., None, :]) + 1).mean(axis=(-2, -1)) / 2)

    found = bootstrap((scores, others), share_of_wins, method="percentile", n_resamples=REPLICATES, rng=0)
    low, high = found.confidence_interval
    return Estimate(float(share_of_wins(scores, others)), float(low), float(high))


def correlation(first: Sequence[Floats], second: Sequence[Floats], *, ranks: bool = False) -> Estimate | None:
    """Correlate two scores, (seeds,) for each row, by Pearson's or Spearman's coefficient, resampling both."""
    pairs, rng = [np.stack(of) for of in zip(first, second, strict=True)], np.random.default_rng(0)
    whole = np.concatenate(pairs, axis=1)
    if whole.shape[1] < LEAST_SEEDS or math.isnan(value := float(_coefficients(whole[None], ranks)[0])):
        return None
    of_a_size: dict[int, list[Floats]] = {}
    for _ in range(REPLICATES):
        rows = [pairs[row] for row in rng.integers(len(pairs), size=len(pairs))]
        drawn = np.concatenate([pair[:, rng.integers(pair.shape[1], size=pair.shape[1])] for pair in rows], axis=1)
        of_a_size.setdefault(drawn.shape[1], []).append(drawn)
    found = [_coefficients(np.stack(samples), ranks) for samples in of_a_size.values()]
    low, high = np.nanquantile(np.concatenate(found), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(value, float(low), float(high))


def _coefficients(pairs: Floats, ranks: bool) -> Floats:
    """Return the coefficient of each of `pairs` (M, 2, N), (M,); NaN where one of the two is constant."""
    from scipy.stats import pearsonr, rankdata

    values = rankdata(pairs, axis=2) if ranks else pairs
    with warnings.catch_warnings(action="ignore"):  # of those that are constant
        return np.asarray(pearsonr(values[:, 0], values[:, 1], axis=1).statistic)


@cache
def _student(count: int) -> float:
    """Return the quantile of Student's t that a 95 % interval of `count` values takes."""
    from scipy.stats import t

    return float(t.ppf((1 + CONFIDENCE) / 2, count - 1))


def _variance(values: Floats) -> float:
    """Return the variance of the mean of values (N,)."""
    return float(values.var(ddof=1)) / len(values)
