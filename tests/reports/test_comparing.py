import numpy as np
import pytest
from fake_runs import bare_results
from scipy.stats import pearsonr, spearmanr

from astra_data.reports.comparing import improvement, summarized, validity
from astra_data.reports.schema import MethodResults
from astra_data.worlds.score import RETURN, SUCCESS

SEEDS = [0, 1, 2]


def row(**changes: object) -> MethodResults:
    (bare,) = bare_results("toy", {"row": SEEDS}, {}).methods.values()
    return bare.model_copy(update=changes)


def test_each_measure_is_summarized_over_the_seeds_that_have_it() -> None:
    found = summarized(row(success=[0.1, 0.2, 0.6], distance=[float("nan"), 4.0, 6.0]), 100).summary
    assert found["success"].mean == pytest.approx(0.3)
    assert [found["distance"].mean, found["distance"].std] == pytest.approx([5.0, np.sqrt(2)])
    assert "simulated_success" not in found
    alone = summarized(row(distance=[float("nan"), 4.0, float("nan")]), 100).summary["distance"]
    assert (alone.mean, alone.std) == (4.0, None)
    assert "distance" not in summarized(row(distance=[float("nan")] * 3), 100).summary


def test_astra_is_compared_with_rows_that_are_trained_alike() -> None:
    """Which of ASTRA's rows did better in the test must not decide which one is compared."""
    trained = [0.0] * 3
    rows = {
        "direct_transfer": row(role="floor", success=[0.25, 0.0, 0.25], simulated_success=trained),
        "a_method_of_ones_own": row(success=[0.0, 0.0, 0.0], simulated_success=trained),
        "astra": row(success=[0.5, 0.25, 0.75], simulated_success=trained),
        "astra_plus": row(success=[1.0, 0.75, 1.0], simulated_success=trained),
        "direct_transfer_plus": row(success=[0.25, 0.0, 0.25], simulated_success=trained),
        # Has no [plus] settings, as it is trained in no simulator.
        "iql": row(success=[0.25, 0.0, 0.25]),
        "follower": row(role="ceiling", success=[1.0, 1.0, 1.0]),
        "target": row(role="trained there", success=[1.0, 1.0, 1.0]),
    }
    found = {
        ours: {other: comparison.probability for other, comparison in others.items()}
        for ours, others in improvement(rows, SUCCESS, 100).items()
    }
    # ASTRA's worst seed ties with two of direct transfer's: two halves of nine pairs are lost.
    assert found == {
        "astra": {
            "direct_transfer": pytest.approx(8 / 9),
            "a_method_of_ones_own": 1.0,
            "iql": pytest.approx(8 / 9),
        },
        "astra_plus": {"direct_transfer_plus": 1.0, "iql": 1.0},
    }
    assert improvement({"iql": rows["iql"]}, SUCCESS, 100) == {}


def test_other_methods_are_compared_where_they_are_named() -> None:
    rows = {name: row(simulated_success=[0.0] * 3) for name in ("nas", "astra", "nas_plus", "a_plus")}
    found = improvement(rows, SUCCESS, 100, ["a", "nas"])
    assert {ours: [*others] for ours, others in found.items()} == {
        "a_plus": ["nas_plus"],
        "nas": ["astra"],
        "nas_plus": ["a_plus"],
    }


def test_a_difference_is_over_the_seeds_that_both_rows_have() -> None:
    rows = {
        "astra": row(seeds=[3, 1, 2], success=[0.9, 0.5, 0.3]),
        "iql": row(seeds=[1, 2, 4], success=[0.1, 0.2, 0.8]),
        "nas": row(seeds=[3], success=[0.4]),
    }
    found = improvement(rows, SUCCESS, 100)["astra"]
    assert found["iql"].difference is not None and found["nas"].difference is None
    assert found["iql"].difference.mean == pytest.approx((0.4 + 0.1) / 2)


def test_rows_are_compared_by_the_headline() -> None:
    rows = {"astra": row(returns=[2.0, 3.0, 4.0]), "iql": row(returns=[1.0, 1.0, 3.0])}
    wins = improvement(rows, RETURN, 100)["astra"]["iql"]
    assert wins.probability == pytest.approx((2 + 2.5 + 3) / 9)
    assert wins.difference is not None and wins.difference.mean == pytest.approx(4 / 3)


def test_validity_is_over_the_policies_that_were_tested_in_a_simulator() -> None:
    rows = {
        "astra": row(returns=[0.0, 1.0, 2.0], simulator_returns={"raw": [0.0, 1.0, 4.0]}),
        "nas": row(
            returns=[1.0, 5.0, 3.0], simulator_returns={"raw": [2.0, 2.0, 7.0], "grounded": [3.0, 1.0, 2.0]}
        ),
        "target": row(returns=[100.0] * 3),
    }
    found = validity(rows, 100)
    raw, grounded = found["raw"], found["grounded"]
    assert (raw.policies, grounded.policies) == (6, 3)
    both = [0.0, 1.0, 4.0, 2.0, 2.0, 7.0], [0.0, 1.0, 2.0, 1.0, 5.0, 3.0]
    assert raw.pearson is not None and raw.spearman is not None
    assert raw.pearson.value == pytest.approx(pearsonr(*both).statistic)
    assert raw.spearman.value == pytest.approx(spearmanr(*both).statistic)
    assert grounded.pearson is not None and grounded.pearson.value == pytest.approx(-1.0)
    assert validity({"target": rows["target"]}, 100) == {}
    two = row(returns=[0.0, 1.0], simulator_returns={"raw": [0.0, 1.0]})
    assert validity({"astra": two}, 100)["raw"].pearson is None
