from collections.abc import Callable
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from rliable import metrics  # type: ignore[import-untyped]
from scipy import stats
from scipy.stats import pearsonr, rankdata, spearmanr, trim_mean, ttest_rel

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.reports.schema import Results
from astra_data.reports.statistics import (
    Summary,
    correlation,
    mean_interval,
    mean_rank_correlation,
    paired_difference,
    probability_of_improvement,
    share_interval,
    summarize,
)

PUBLISHED = Path(__file__).parents[2] / "recipes/results"


def ends(values: Floats) -> Floats:
    """Return the ends of the 95 % interval: a fortieth of the replicates lies beyond each."""
    values = np.sort(values)
    return values[[len(values) // 40, -len(values) // 40]]


def drawn(scores: Floats, replicates: int = 10_000) -> Floats:
    """Return resamples of `scores` (seeds,) with replacement, (replicates, seeds)."""
    rng = np.random.default_rng(1)
    return rng.permuted(scores[rng.integers(len(scores), size=(replicates, len(scores)))], axis=1)


def test_summary_of_five_seeds_is_the_one_worked_out_by_hand() -> None:
    summary = summarize(np.array([0.1, 0.2, 0.4, 0.5, 0.8]), replicates=200)
    assert summary.mean == pytest.approx(0.4)
    # Squares of the deviations from 0.4: 0.09 + 0.04 + 0 + 0.01 + 0.16 = 0.30, over 4.
    assert summary.std == pytest.approx(np.sqrt(0.075))
    # A quarter of five seeds is one from each end: the mean of 0.2, 0.4 and 0.5.
    assert summary.iqm == pytest.approx(1.1 / 3)
    assert summary.low is not None and summary.high is not None
    assert 0.1 <= summary.low < summary.iqm < summary.high <= 0.8


def test_one_seed_has_neither_spread_nor_interval() -> None:
    assert summarize(np.array([0.7])) == Summary(0.7, None, 0.7, None, None)
    several_tasks = summarize(np.array([[0.25, 0.75]]))
    assert several_tasks == Summary(0.5, None, 0.5, None, None)


def test_equal_seeds_have_an_interval_without_width() -> None:
    assert summarize(np.full(3, 0.5), replicates=100) == Summary(0.5, 0.0, 0.5, 0.5, 0.5)


def test_the_interval_holds_95_percent_of_the_resampled_interquartile_means() -> None:
    scores = np.random.default_rng(0).normal(5.0, 2.0, 24)
    summary = summarize(scores, replicates=2000)
    means = trim_mean(drawn(scores), 0.25, axis=1)
    # A 90 % interval would be 0.16 of a half-width narrower at each end, two of these tolerances.
    tolerance = 0.08 * float(np.ptp(ends(means))) / 2
    assert [summary.low, summary.high] == pytest.approx(ends(means), abs=tolerance)


def test_tasks_are_strata() -> None:
    # Within each task all seeds agree, so resampling seeds within tasks changes nothing.
    summary = summarize(np.array([[0.0, 1.0], [0.0, 1.0], [0.0, 1.0]]), replicates=100)
    assert (summary.low, summary.high, summary.std) == (summary.iqm, summary.iqm, 0.0)


def test_seeds_are_resampled_in_each_task_apart_but_spread_is_that_of_their_means() -> None:
    first = np.random.default_rng(0).uniform(0, 1, 20)
    summary = summarize(np.stack([first, 1 - first], axis=1), replicates=2000)
    # Every seed has the mean 0.5 over its two tasks.
    assert [summary.mean, summary.std] == pytest.approx([0.5, 0.0])
    both = np.concatenate([drawn(first), 1 - drawn(first)[::-1]], axis=1)
    expected = ends(trim_mean(both, 0.25, axis=1))
    assert [summary.low, summary.high] == pytest.approx(expected, abs=0.08 * float(np.ptp(expected)) / 2)


def test_intervals_are_reproducible_and_leave_the_global_generator_alone() -> None:
    scores = np.array([0.1, 0.5, 0.2, 0.9])
    first = summarize(scores, replicates=100)
    np.random.seed(123)
    state = np.random.get_state()[1].tolist()  # type: ignore[index]
    assert summarize(scores, replicates=100) == first
    assert np.random.get_state()[1].tolist() == state  # type: ignore[index]


def test_published_intervals_come_out_again() -> None:
    """The bootstrap's seed and its number of replicates are what they were."""
    found = Results.model_validate_json((PUBLISHED / "antmaze_umaze.json").read_text())
    astra, other = found.methods["astra"], found.methods["direct_transfer"]
    ours, theirs = np.array(astra.success), np.array(other.success)
    assert summarize(ours) == astra.summary["success"]
    published = found.probability_of_improvement["astra"]["direct_transfer"]
    difference = paired_difference(ours, theirs)
    assert replace(probability_of_improvement(ours, theirs), difference=difference) == published
    rows = [row for row in found.methods.values() if "raw" in row.simulator_returns]
    simulated = [np.array(row.simulator_returns["raw"]) for row in rows]
    target = [np.array(row.returns) for row in rows]
    published_correlation = found.predictive_validity["raw"].spearman
    again = correlation(simulated, target, ranks=True)
    assert again is not None and published_correlation is not None
    assert astuple(again) == pytest.approx(astuple(published_correlation))


@pytest.mark.parametrize(
    ("scores", "others", "probability"),
    [
        ([0.8, 0.9], [0.1, 0.2], 1.0),
        ([0.1, 0.2], [0.8, 0.9], 0.0),
        ([0.5, 0.9], [0.5, 0.7], 0.625),  # a tie, a loss, two wins
        ([0.5], [0.5], 0.5),
        ([0.5], [0.4, 0.6], 0.5),
        ([0.4, 0.6], [0.3], 1.0),
    ],
)
def test_probability_of_improvement_counts_pairs(
    scores: list[float], others: list[float], probability: float
) -> None:
    comparison = probability_of_improvement(np.array(scores), np.array(others), replicates=100)
    assert comparison.probability == probability
    # Where a row has a single seed, resampling it says nothing.
    assert (comparison.low is None) == (comparison.high is None) == (min(len(scores), len(others)) == 1)


def test_the_probability_of_improvement_has_a_95_percent_interval() -> None:
    rng = np.random.default_rng(0)
    scores, others = rng.normal(0.6, 1, 20), rng.normal(0, 1, 14)
    found = probability_of_improvement(scores, others, replicates=2000)
    ours, theirs = drawn(scores)[:, :, None], drawn(others)[::-1, None]
    expected = ends((ours > theirs).mean(axis=(1, 2)))
    assert [found.low, found.high] == pytest.approx(expected, abs=0.08 * float(np.ptp(expected)) / 2)
    # From the other side everything is the other way round.
    back = probability_of_improvement(others, scores, replicates=2000)
    mirrored = 1 - np.array([found.probability, expected[1], expected[0]])
    assert [back.probability, back.low, back.high] == pytest.approx(mirrored, abs=0.03)


def test_the_difference_of_paired_seeds_is_that_of_a_paired_t_test() -> None:
    rng = np.random.default_rng(0)
    seeds = rng.normal(0, 1, 7)
    ours, theirs = seeds + rng.normal(0.3, 0.1, 7), seeds + rng.normal(0, 0.1, 7)
    found = paired_difference(ours, theirs)
    interval = ttest_rel(ours, theirs).confidence_interval(0.95)
    expected = [(ours - theirs).mean(), interval.low, interval.high]
    assert [found.mean, found.low, found.high] == pytest.approx(expected)


@pytest.mark.parametrize("seeds", [1, 5, 8])
def test_figures_are_those_of_rliable(seeds: int) -> None:
    rng = np.random.default_rng(seeds)
    scores, others = (rng.integers(0, 5, (count, 3)) / 4 for count in (seeds, 6))  # with ties
    assert summarize(scores, replicates=10).iqm == metrics.aggregate_iqm(scores)
    found = probability_of_improvement(scores, others, replicates=10).probability
    assert found == pytest.approx(metrics.probability_of_improvement(scores, others), abs=1e-12)


@pytest.mark.parametrize("in_one_row", [False, True])
@pytest.mark.parametrize(("ranks", "reference"), [(False, pearsonr), (True, spearmanr)])
def test_correlations_are_those_of_scipy(
    ranks: bool, reference: Callable[..., object], in_one_row: bool
) -> None:
    rng = np.random.default_rng(0)
    first = rng.integers(0, 6, 30).astype(float)  # with ties
    second = np.exp(first) + rng.normal(0, 30, 30)
    # With a seed per row resampling rows is the ordinary bootstrap, as is that of seeds in a single row.
    parts = 1 if in_one_row else 30
    rows = np.split(first, parts), np.split(second, parts)
    found = correlation(*rows, ranks=ranks, replicates=2000)
    assert found is not None
    assert found.value == pytest.approx(reference(first, second).statistic)  # type: ignore[attr-defined]
    pairs = rng.integers(30, size=(8000, 30))
    one, other = first[pairs], second[pairs]
    if ranks:
        one, other = rankdata(one, axis=1), rankdata(other, axis=1)
    one, other = (values - values.mean(axis=1, keepdims=True) for values in (one, other))
    spread = np.sqrt((one**2).sum(axis=1) * (other**2).sum(axis=1))
    expected = ends((one * other).sum(axis=1) / spread)
    assert [found.low, found.high] == pytest.approx(expected, abs=0.08 * float(np.ptp(expected)) / 2)
    assert correlation(*rows, ranks=ranks, replicates=2000) == found


def test_seeds_of_a_row_are_no_independent_evidence() -> None:
    generator = np.random.default_rng(0)
    misses = 0
    for _ in range(100):
        row, other_row = generator.normal(0, 1, (2, 8, 1))
        scores, others = (values + generator.normal(0, 0.3, (8, 10)) for values in (row, other_row))
        found = correlation(list(scores), list(others), replicates=200)
        assert found is not None
        misses += not found.low <= 0.0 <= found.high
    # A bootstrap of eight rows covers somewhat less than 95 %; of eighty policies, a third.
    assert misses <= 25


def test_rows_of_different_lengths_are_resampled_within_themselves() -> None:
    # The seeds of the first row are alike in both scores, those of the second all lie on a falling line.
    first = [np.zeros(2), np.array([1.0, 2.0, 3.0, 4.0])]
    second = [np.zeros(2), np.array([-1.0, -2.0, -3.0, -4.0])]
    found = correlation(first, second, replicates=200)
    assert found is not None
    assert [found.value, found.low, found.high] == pytest.approx([-1.0, -1.0, -1.0])


def test_what_does_not_vary_correlates_with_nothing() -> None:
    two, three = [np.array([1.0, 2.0])], np.split(np.array([0.1, 0.1, 0.3]), 3)
    same = np.split(np.full(3, 0.1), 3)
    assert correlation(two, two) is None
    assert correlation(three, same) is correlation(same, three) is None
    # Nor do the resamples in which chance left no variation.
    found = correlation(three, three)
    assert found is not None
    assert [found.low, found.high] == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize("scores", [[], [0.1, np.nan], [0.1, np.inf]])
def test_missing_scores_are_refused(scores: list[float]) -> None:
    with pytest.raises(BadInputError, match="one finite score per seed"):
        summarize(np.array(scores))
    with pytest.raises(BadInputError, match="one finite score per seed"):
        probability_of_improvement(np.array([0.1, 0.2]), np.array(scores))


def test_the_mean_of_shares_has_students_interval() -> None:
    shares = [0.2, 0.4, 0.3, 0.5, 0.6]
    expected = stats.t.interval(0.95, 4, loc=0.4, scale=stats.sem(shares))
    assert mean_interval(shares) == pytest.approx(expected)
    assert mean_interval([0.0, 1.0]) == (0.0, 1.0)


@pytest.mark.parametrize(("count", "total"), [(64, 100), (0, 20), (7, 7), (1, 4)])
def test_the_interval_of_a_share_is_wilsons(count: int, total: int) -> None:
    share, z = count / total, stats.norm.ppf(0.975)
    middle = (share + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z / (1 + z**2 / total) * np.sqrt(share * (1 - share) / total + z**2 / (4 * total**2))
    assert share_interval(count, total) == pytest.approx((middle - half, middle + half), abs=1e-9)


def test_students_interval_covers_the_mean_where_a_bootstrap_does_not() -> None:
    rng = np.random.default_rng(0)
    samples = rng.beta(4, 4, (400, 4))
    found = [mean_interval(list(sample)) for sample in samples]
    assert np.mean([low <= 0.5 <= high for low, high in found]) == pytest.approx(0.95, abs=0.03)
    resampled = np.array([rng.choice(sample, (500, 4)).mean(axis=1) for sample in samples])
    low, high = np.quantile(resampled, [0.025, 0.975], axis=1)
    assert np.mean((low <= 0.5) & (high >= 0.5)) < 0.87


def test_ranks_are_correlated_within_rows() -> None:
    rng = np.random.default_rng(0)
    rows = [
        {seed: (float(one), float(one + rng.normal())) for seed, one in enumerate(rng.normal(size=9))}
        for _ in range(3)
    ]
    found = mean_rank_correlation(rows, least=3, replicates=500)
    expected = np.mean([stats.spearmanr(*np.array(list(row.values())).T).statistic for row in rows])
    assert found is not None and found.value == pytest.approx(expected)
    assert -1 <= found.low < found.value < found.high <= 1
    of_rows = []
    draws = rng.integers(9, size=(4000, 9))
    for row in rows:
        one, other = np.array(list(row.values())).T
        ranks = [rankdata(side[draws], axis=1) for side in (one, other)]
        of_rows.append([np.corrcoef(*pair)[0, 1] for pair in zip(*ranks, strict=True)])
    # At 90 % the lower end would be two tolerances higher.
    low, high = ends(np.mean(of_rows, axis=0))
    assert [found.low, found.high] == pytest.approx([low, high], abs=0.07 * (high - low))
    again = mean_rank_correlation(rows, least=3, replicates=500)
    assert again == found
    short = {seed: (float(seed), -float(seed)) for seed in (0, 1)}
    assert mean_rank_correlation([*rows, short], least=3, replicates=10) is not None
    assert mean_rank_correlation([*rows, short], least=3, replicates=500).value == found.value  # type: ignore[union-attr]
    level = {seed: (1.0, float(seed)) for seed in range(5)}
    assert mean_rank_correlation([short, level], least=3) is None


def test_seeds_are_resampled_for_all_rows_at_once() -> None:
    """Two rows with the same scores are no more certain than one."""
    rng = np.random.default_rng(1)
    row = {seed: (float(rng.normal()), float(rng.normal())) for seed in range(8)}
    one, two = (mean_rank_correlation([row] * count, least=3, replicates=300) for count in (1, 2))
    assert one == two
