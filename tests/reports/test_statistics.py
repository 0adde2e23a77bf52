from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats
from scipy.stats import pearsonr, rankdata, spearmanr

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.reports.statistics import (
    Estimate,
    correlation,
    ends,
    interval,
    paired_difference,
    probability_of_improvement,
    spread,
    success_rate,
    summarize,
)

EPISODES = 120
Draw = Callable[[np.random.Generator, tuple[int, int]], Floats]

SEEDS: dict[str, Draw] = {
    "middling": lambda rng, size: rng.beta(10, 10, size),
    "good": lambda rng, size: rng.beta(18, 2, size),
    "good and scattered": lambda rng, size: rng.beta(4, 1, size),
    "bad": lambda rng, size: rng.beta(1, 9, size),
    "equal": lambda _, size: np.full(size, 0.99),
}
"""Success rates that trainings of a method might have."""


def tails(values: Floats) -> Floats:
    """Return the ends of the 95 % interval: a fortieth of the replicates lies beyond each."""
    values = np.sort(values)
    return values[[len(values) // 40, -len(values) // 40]]


def intervals(shares: Floats, trials: int = 0) -> Floats:
    found = [summarize(of, limit=1.0, trials=trials) for of in shares]
    return np.array([(one.low, one.high) for one in found])


@pytest.mark.parametrize("count", [3, 10])
@pytest.mark.parametrize("seeds", SEEDS)
def test_intervals_of_success_rates_cover_their_mean(seeds: str, count: int) -> None:
    """In 1,000 experiments a coverage of 0.95 comes out below 0.93 with a probability of 0.3 %."""
    rng = np.random.default_rng(0)
    mean = SEEDS[seeds](rng, (200_000, 1)).mean()
    shares = rng.binomial(EPISODES, SEEDS[seeds](rng, (1000, count))) / EPISODES
    found = intervals(shares, trials=EPISODES)
    assert ((found >= 0) & (found <= 1)).all()
    assert np.mean((found[:, 0] <= mean) & (mean <= found[:, 1])) >= 0.93
    if seeds == "good and scattered" and count == 3:  # Student's t alone would be too narrow where seeds are near 1
        student = intervals(shares)
        assert np.mean((student[:, 0] <= mean) & (mean <= student[:, 1])) < 0.93


@pytest.mark.parametrize("count", [3, 10])
@pytest.mark.parametrize("seeds", ["good", "equal"])
def test_intervals_of_differences_cover_them(seeds: str, count: int) -> None:
    rng = np.random.default_rng(0)
    sides = [rng.binomial(EPISODES, SEEDS[seeds](rng, (1000, count))) / EPISODES for _ in range(2)]
    covered = 0
    for ours, theirs in zip(*sides, strict=True):
        found = paired_difference(dict(enumerate(ours)), dict(enumerate(theirs)), limit=1.0, trials=EPISODES)
        assert found and found.low is not None and found.high is not None
        assert -1.0 <= found.low <= found.high <= 1.0
        covered += found.low <= 0.0 <= found.high
    assert covered >= 930


def test_a_summary_is_the_one_worked_out_by_hand() -> None:
    values = [0.1, 0.2, 0.4, 0.5, 0.8]
    # Squares of the deviations from 0.4: 0.09 + 0.04 + 0 + 0.01 + 0.16 = 0.30, over 4.
    low, high = stats.t.interval(0.95, 4, loc=0.4, scale=np.sqrt(0.075 / 5))
    found = summarize(values)
    assert [found.value, found.std, found.low, found.high] == pytest.approx([0.4, np.sqrt(0.075), low, high])
    assert summarize(values, limit=0.7).high == 0.7


@pytest.mark.parametrize("values", [[0.7], [0.1, 0.1]])
def test_below_three_seeds_there_is_no_interval(values: list[float]) -> None:
    std = None if len(values) == 1 else 0.0
    alone = Estimate(values[0], std=std, seeds=len(values))
    assert summarize(values, limit=1.0, trials=EPISODES) == alone and ends(alone) == "-"
    here, there = dict(enumerate(values)), dict(enumerate([0.0] * len(values)))
    assert paired_difference(here, there, limit=1.0) == Estimate(values[0])
    sides = np.array(values), np.array([0.1, 0.2, 0.3])
    assert probability_of_improvement(*sides) is probability_of_improvement(*sides[::-1]) is None


def test_equal_shares_have_an_interval_as_wide_as_drawing_their_episodes() -> None:
    quantile = stats.t.ppf(0.975, 2)  # Wilson's of 360 successes of 360, with this quantile
    equal = summarize([1.0] * 3, limit=1.0, trials=EPISODES)
    assert equal.low == pytest.approx(1 / (1 + quantile**2 / 360)) and equal.high == 1.0
    found = paired_difference(dict.fromkeys(range(3), 0.6), dict.fromkeys(range(3), 0.5), trials=EPISODES)
    near = np.array([216 + 2, 180 + 2]) / 364  # with two successes and two failures more, of 360 episodes a side
    assert found and found.low == pytest.approx(0.1 - quantile * np.sqrt((near * (1 - near)).sum() / 360))
    # A variance of 0.01 / 3, or 0.04 / 9 with one seed more, is that of 0.09 * 9 / 0.04 episodes.
    extra = quantile**2 / 20.25
    wilson = (0.9 + extra / 2 - np.sqrt(0.09 * extra + extra**2 / 4)) / (1 + extra)
    assert summarize([0.8, 0.9, 1.0], limit=1.0, trials=EPISODES).low == pytest.approx(wilson)


def test_a_difference_is_that_of_a_paired_t_test_on_the_seeds_that_both_have() -> None:
    rng = np.random.default_rng(0)
    seeds = rng.normal(0, 1, 7)
    ours, theirs = seeds + rng.normal(0.3, 0.1, 7), seeds + rng.normal(0, 0.1, 7)
    ours, theirs = ours / 9 + 0.5, theirs / 9 + 0.5
    found = paired_difference(dict(enumerate(ours)) | {9: 5.0}, dict(enumerate(theirs)))
    # Drawing episodes scatters less.
    assert found == paired_difference(dict(enumerate(ours)), dict(enumerate(theirs)), trials=10**6)
    expected = stats.ttest_rel(ours, theirs).confidence_interval(0.95)
    assert found is not None
    assert [found.value, found.low, found.high] == pytest.approx([(ours - theirs).mean(), expected.low, expected.high])
    assert paired_difference({0: 0.1}, {1: 0.2}) is None
    clear = paired_difference({0: 1.0, 1: 0.9, 2: 0.9}, dict.fromkeys(range(3), 0.0), limit=1.0)
    assert clear and clear.high == 1.0


@pytest.mark.parametrize("scores", [[], [0.1, np.nan], [0.1, np.inf]])
def test_missing_scores_are_refused(scores: list[float]) -> None:
    with pytest.raises(BadInputError, match="one finite score per seed"):
        summarize(np.array(scores))


def test_the_probability_of_improvement_counts_pairs_and_has_a_95_percent_interval() -> None:
    found = probability_of_improvement(np.array([0.5, 0.9, 0.1]), np.array([0.5, 0.7, 0.0]))
    assert found is not None and found.value == pytest.approx((0.5 + 0 + 1 + 1 + 1 + 1 + 0 + 0 + 1) / 9)
    rng = np.random.default_rng(0)
    scores, others = rng.normal(0.6, 1, 20), rng.normal(0, 1, 14)
    found = probability_of_improvement(scores, others)
    ours, theirs = (of[rng.integers(len(of), size=(8000, len(of)))] for of in (scores, others))
    expected = tails((ours[:, :, None] > theirs[:, None]).mean(axis=(1, 2)))
    assert found is not None
    assert [found.low, found.high] == pytest.approx(expected, abs=0.08 * float(np.ptp(expected)) / 2)
    assert probability_of_improvement(scores, others) == found


@pytest.mark.parametrize(("ranks", "reference", "parts"), [(False, pearsonr, 1), (True, spearmanr, 30)])
def test_correlations_are_those_of_scipy(ranks: bool, reference: Callable[..., object], parts: int) -> None:
    rng = np.random.default_rng(0)
    first = rng.integers(0, 6, 30).astype(float)  # with ties
    second = np.exp(first) + rng.normal(0, 30, 30)
    # With a seed per row resampling rows is the ordinary bootstrap, as is that of seeds in a single row.
    found = correlation(np.split(first, parts), np.split(second, parts), ranks=ranks)
    assert found is not None
    assert found.value == pytest.approx(reference(first, second).statistic)  # type: ignore[attr-defined]
    pairs = rng.integers(30, size=(4000, 30))
    one, other = (rankdata(of[pairs], axis=1) if ranks else of[pairs] for of in (first, second))
    expected = tails(np.array([np.corrcoef(*pair)[0, 1] for pair in zip(one, other, strict=True)]))
    assert [found.low, found.high] == pytest.approx(expected, abs=0.1 * float(np.ptp(expected)) / 2)


def test_seeds_of_a_row_are_no_independent_evidence() -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(0, 1, (2, 4, 1))
    scores, others = rows + rng.normal(0, 0.01, (2, 4, 8))
    rowwise, apart = (correlation(*(np.split(of.ravel(), parts) for of in (scores, others))) for parts in (4, 32))
    assert rowwise and apart and rowwise.low is not None and rowwise.high is not None
    assert apart.low is not None and apart.high is not None
    assert rowwise.high - rowwise.low > 2 * (apart.high - apart.low)


def test_what_does_not_vary_correlates_with_nothing() -> None:
    two, three = [np.array([1.0, 2.0])], np.split(np.array([0.1, 0.1, 0.3]), 3)
    assert correlation(two, two) is None and correlation(three, np.split(np.full(3, 0.1), 3)) is None
    found = correlation(three, three)  # nor do the resamples in which chance left no variation
    assert found is not None and [found.low, found.high] == pytest.approx([1.0, 1.0])


def test_figures_are_written_with_deviation_or_interval() -> None:
    found = Estimate(0.5, 0.125, 1.0, std=0.25, seeds=3)
    assert (spread(found, 2), ends(found), interval(found)) == ("0.50 ± 0.25", "[0.12, 1.00]", "0.50 [0.12, 1.00]")
    assert (spread(Estimate(-0.4), 0), interval(Estimate(-0.01, -0.04, 0.0), 1)) == ("0", "0.0 [0.0, 0.0]")
    assert (spread(None, 2), ends(None), interval(None)) == ("-", "-", "-")


@pytest.mark.parametrize(("successes", "trials"), [(0, 7), (4, 8), (7, 7), (40, 60)])
def test_a_rate_without_predictions_has_wilsons_interval(successes: int, trials: int) -> None:
    outcomes = [1.0] * successes + [0.0] * (trials - successes)
    expected = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    # Predictions that do not vary, or of trials that all end alike, change nothing.
    for predicted in ([], [0.3] * trials):
        found = success_rate(outcomes, predicted, 0.9, 500)
        assert [found.value, found.low, found.high] == pytest.approx([successes / trials, expected.low, expected.high])
    assert success_rate([1.0] * 3, [0.1, 0.2, 0.3], 0.9, 500) == success_rate([1.0] * 3, [], 0.9, 500)
    assert success_rate([], [], 0.75, 500) == Estimate(0.75, 0.0, 1.0)


def test_a_rate_is_corrected_by_what_the_prediction_explains() -> None:
    outcomes, predicted = [1.0, 1.0, 0.0, 1.0, 0.0], [0.8, 0.6, 0.2, 0.8, 0.6]
    # By hand: the covariance is 0.8 / 25 · 5 / 2 = 0.08 · 5 / 5, the variance of the predictions 0.048.
    covariance, variance = np.cov(outcomes, predicted, ddof=0)[0, 1], np.var(predicted)
    slope = covariance / variance / (1 + 5 / 20)
    assert slope == pytest.approx(0.08 / 0.048 / 1.25) and slope > 1
    slope = 1.0  # at most
    value = 0.6 + slope * (0.5 - 0.6)
    left = (np.sum((np.array(outcomes) - predicted - 0.0) ** 2) + 2 * 0.25) / (4 + 2) + 0.5 * 0.5 * 5 / 20
    trials = 5 * 0.25 / left
    center, half = (value + 1.96**2 / 2 / trials), 1.96 * np.sqrt(value * (1 - value) / trials + (0.98 / trials) ** 2)
    found = success_rate(outcomes, predicted, 0.5, 20)
    expected = [value, *((center + side * half) / (1 + 1.96**2 / trials) for side in (-1, 1))]
    assert [found.value, found.low, found.high] == pytest.approx(expected, abs=1e-4)
    # A smaller slope is taken as it is; one below 0 is none.
    weak = success_rate([1.0, 0.0, 1.0, 0.0], [0.9, 0.5, 0.5, 0.1], 0.2, 4)
    assert weak.value == pytest.approx(0.5 + 0.1 / 0.08 / 2 * (0.2 - 0.5))
    assert success_rate([1.0, 0.0, 0.0], [0.1, 0.8, 0.9], 0.4, 20) == success_rate([1.0, 0.0, 0.0], [], 0.4, 20)
    # It stays one that the trials alone allow, however far the starts were from usual ones.
    beyond = success_rate([1.0, 1.0, 0.0, 1.0], [0.2, 0.2, 0.0, 0.2], 0.9, 10**6)
    alone = stats.binomtest(3, 4).proportion_ci(method="wilson")
    assert beyond.value == pytest.approx(alone.high) and beyond.low is not None and beyond.low > 0.3
    few = success_rate([1.0, 0.0], [1.0, 0.9], 0.4, 100)  # of one success in two trials none makes a rate of 0
    assert few.value == pytest.approx(stats.binomtest(1, 2).proportion_ci(method="wilson").low)


@pytest.mark.parametrize("rate", [0.005, 0.985, 0.995])
@pytest.mark.parametrize("count", [10, 20, 50])
def test_the_interval_of_a_rate_near_an_end_covers_it(rate: float, count: int) -> None:
    chances = stats.binom.pmf(np.arange(count + 1), count, rate)
    found = [success_rate([1.0] * n + [0.0] * (count - n), [], 0.5, 1) for n in range(count + 1)]
    is_covered = [one.low is not None and one.high is not None and one.low <= rate <= one.high for one in found]
    assert chances @ is_covered >= 0.93  # of Wilson's, 0.86 at worst
    # One success in ten: as rare as 5 % where 1 - exp(-10 · rate) is 0.05.
    assert success_rate([1.0] + [0.0] * 9, [], 0.5, 1).low == pytest.approx(-np.log(0.95) / 10)


@pytest.mark.parametrize("rates", [(0.5, 0.5), (0.2, 0.95), (0.0, 0.6), (0.97, 1.0), (0.02, 0.05)])
@pytest.mark.parametrize("count", [10, 20, 50])
def test_the_interval_of_a_rate_covers_it_and_is_narrower_where_the_prediction_is_good(
    rates: tuple[float, float], count: int
) -> None:
    rng, covered, widths = np.random.default_rng(count), 0, np.zeros((1000, 2))
    told = np.array([0.1, 0.7])  # of hard and of easy starts: wrong, but of the right order
    for width in widths:
        easy = rng.integers(2, size=count)
        outcomes = rng.binomial(1, np.array(rates)[easy]).tolist()
        mean = rng.binomial(400, told.mean()) / 400
        found, alone = success_rate(outcomes, told[easy].tolist(), mean, 400), success_rate(outcomes, [], mean, 400)
        assert found.low is not None and found.high is not None and alone.low is not None and alone.high is not None
        covered += int(found.low <= np.mean(rates) <= found.high)
        width[:] = found.high - found.low, alone.high - alone.low
    assert covered >= 920
    shorter = 1 - widths.mean(axis=0)[0] / widths.mean(axis=0)[1]
    assert shorter > 0.12 if rates == (0.2, 0.95) else shorter > -0.03
