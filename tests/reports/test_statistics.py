from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import bootstrap, pearsonr, spearmanr

from astra_data.core.errors import BadInputError
from astra_data.reports.statistics import Summary, correlation, probability_of_improvement, summarise


def test_summary_of_five_seeds_is_the_one_worked_out_by_hand() -> None:
    summary = summarise(np.array([0.1, 0.2, 0.4, 0.5, 0.8]), replicates=200)
    assert summary.mean == pytest.approx(0.4)
    # Squares of the deviations from 0.4: 0.09 + 0.04 + 0 + 0.01 + 0.16 = 0.30, over 4.
    assert summary.std == pytest.approx(np.sqrt(0.075))
    # A quarter of five seeds is one from each end: the mean of 0.2, 0.4 and 0.5.
    assert summary.iqm == pytest.approx(1.1 / 3)
    assert summary.low is not None and summary.high is not None
    assert 0.1 <= summary.low < summary.iqm < summary.high <= 0.8


def test_one_seed_has_neither_spread_nor_interval() -> None:
    assert summarise(np.array([0.7])) == Summary(0.7, None, 0.7, None, None)


def test_equal_seeds_have_an_interval_without_width() -> None:
    assert summarise(np.full(3, 0.5), replicates=100) == Summary(0.5, 0.0, 0.5, 0.5, 0.5)


def test_tasks_are_strata() -> None:
    # Within each task all seeds agree, so resampling seeds within tasks changes nothing.
    summary = summarise(np.array([[0.0, 1.0], [0.0, 1.0], [0.0, 1.0]]), replicates=100)
    assert (summary.low, summary.high, summary.std) == (summary.iqm, summary.iqm, 0.0)


def test_intervals_are_reproducible_and_leave_the_global_generator_alone() -> None:
    scores = np.array([0.1, 0.5, 0.2, 0.9])
    first = summarise(scores, replicates=100)
    state = np.random.get_state()[1].tolist()  # type: ignore[index]
    assert summarise(scores, replicates=100) == first
    assert np.random.get_state()[1].tolist() == state  # type: ignore[index]


def test_the_interval_covers_the_mean_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(0)
    inside = 0
    for _ in range(40):
        summary = summarise(generator.normal(0.5, 0.1, size=20), replicates=200)
        assert summary.low is not None and summary.high is not None
        inside += summary.low <= 0.5 <= summary.high
    assert inside / 40 == pytest.approx(0.93, abs=0.07)


@pytest.mark.parametrize(
    ("scores", "others", "probability"),
    [
        ([0.8, 0.9], [0.1, 0.2], 1.0),
        ([0.1, 0.2], [0.8, 0.9], 0.0),
        ([0.5, 0.9], [0.5, 0.7], 0.625),  # a tie, a loss, two wins
        ([0.5], [0.5], 0.5),
    ],
)
def test_probability_of_improvement_counts_pairs(
    scores: list[float], others: list[float], probability: float
) -> None:
    comparison = probability_of_improvement(np.array(scores), np.array(others), replicates=100)
    assert comparison.probability == probability
    assert (comparison.low is None) == (len(scores) == 1)


@pytest.mark.parametrize(("ranks", "reference"), [(False, pearsonr), (True, spearmanr)])
def test_correlations_are_those_of_scipy(ranks: bool, reference: Callable[..., Any]) -> None:
    generator = np.random.default_rng(0)
    first = generator.integers(0, 6, 30).astype(float)  # with ties
    second = np.exp(first) + generator.normal(0, 30, 30)
    # With a seed per row, resampling rows is the ordinary bootstrap.
    alone = np.split(first, 30), np.split(second, 30)
    found = correlation(*alone, ranks=ranks)
    assert found is not None
    assert found.value == pytest.approx(reference(first, second).statistic)
    expected = bootstrap(
        (first, second),
        lambda *pairs: reference(*pairs).statistic,
        paired=True,
        vectorized=False,
        n_resamples=500,
        method="percentile",
        rng=generator,
    ).confidence_interval
    assert (found.low, found.high) == pytest.approx(tuple(expected), abs=0.05)
    assert correlation(*alone, ranks=ranks) == found


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


def test_what_does_not_vary_correlates_with_nothing() -> None:
    two, three = [np.array([1.0, 2.0])], np.split(np.array([0.1, 0.1, 0.3]), 3)
    same = np.split(np.full(3, 0.1), 3)
    assert correlation(two, two) is None
    assert correlation(three, same) is correlation(same, three) is None
    # Nor do the resamples in which chance left no variation.
    found = correlation(three, three)
    assert found is not None
    assert [found.low, found.high] == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize("scores", [[], [0.1, np.nan]])
def test_missing_scores_are_refused(scores: list[float]) -> None:
    with pytest.raises(BadInputError, match="one finite score per seed"):
        summarise(np.array(scores))
