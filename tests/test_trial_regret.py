import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from fake_runs import bare_results
from scipy.stats import binom, hypergeom
from trial_regret import (
    Pool,
    _Deck,
    at_random,
    by_equal_shares,
    by_halving,
    estimate,
    mean_regret,
    pools_of,
)

from astra_data.core.errors import BadInputError
from astra_data.reports.schema import Choice, Ranked, Results


def pool(seed: int, lower: float, success: float, episodes: int = 100) -> Pool:
    return Pool(seed, lower, lower, episodes, round(success * episodes))


PERFECT = [pool(n, share, share) for n, share in enumerate((0.2, 0.9, 0.5, 0.4))]
REVERSED = [pool(n, 1 - share, share) for n, share in enumerate((0.2, 0.9, 0.5, 0.4))]


def regret(pools: list[Pool], trials: int, *, halving: bool = True, repeats: int = 300) -> float:
    choose = by_halving if halving else by_equal_shares
    return mean_regret(pools, trials, choose, repeats=repeats, rng=np.random.default_rng(0))


def test_a_perfect_prediction_has_no_regret() -> None:
    assert regret(PERFECT, 0) == 0.0
    sure = [pool(n, share, share) for n, share in enumerate((0.0, 1.0, 0.0))]
    assert regret(sure, 100) == 0.0


def test_the_best_without_trials_is_what_is_predicted() -> None:
    assert regret(REVERSED, 0) == pytest.approx(0.9 - 0.2)
    level = [Pool(0, 0.5, 0.6, 10, 10), Pool(1, 0.5, 0.7, 10, 0)]
    assert regret(level, 0) == 1.0  # the mean over judges decides between equal quartiles


def test_trials_make_up_for_a_wrong_prediction() -> None:
    found = [regret(REVERSED, trials) for trials in (0, 20, 100, 400)]
    assert found == sorted(found, reverse=True) and found[-1] < 0.01


def test_one_drawn_at_random_has_the_mean_regret() -> None:
    found = mean_regret(PERFECT, 50, at_random, repeats=4000, rng=np.random.default_rng(0))
    assert found == pytest.approx(0.9 - 0.5, abs=0.02)


def test_equal_shares_choose_as_often_as_the_counts_say() -> None:
    """Of two pools, each tried five times without replacement; a tie is drawn by lot."""
    pools = [pool(0, 0.5, 0.4, 10), pool(1, 0.5, 0.6, 10)]
    wrong = 0.0
    for one, other in product(range(6), repeat=2):
        chance = hypergeom.pmf(one, 10, 4, 5) * hypergeom.pmf(other, 10, 6, 5)
        wrong += chance * (1.0 if one > other else 0.5 if one == other else 0.0)
    assert regret(pools, 10, halving=False, repeats=6000) == pytest.approx(0.2 * wrong, abs=0.006)


def test_fewer_trials_than_pools_try_some_once() -> None:
    """One trial: whoever is drawn is chosen."""
    assert regret(PERFECT, 1, halving=False, repeats=4000) == pytest.approx(0.9 - 0.5, abs=0.02)


def test_episodes_are_drawn_without_replacement_until_they_are_used_up() -> None:
    rng = np.random.default_rng(0)
    deck = _Deck(pool(0, 0.5, 0.3, 10), rng)
    assert deck.draw(4) + deck.draw(6) == 3
    assert _Deck(pool(0, 0.5, 0.3, 10), rng).draw(30) == 9
    counts = [_Deck(pool(0, 0.5, 0.3, 10), rng).draw(12) - 3 for _ in range(4000)]
    assert np.mean(counts) == pytest.approx(0.6, abs=0.03)
    assert np.mean([count == 2 for count in counts]) == pytest.approx(3 / 45, abs=0.015)
    assert binom.pmf(2, 2, 0.3) == pytest.approx(0.09)  # with replacement it would be


def test_an_interval_resamples_the_seeds_of_the_run() -> None:
    found = estimate(REVERSED, 0, by_halving, repeats=10, resamples=400)
    # Of seeds that are drawn anew, the best predicted is the worst: no regret if all are one and the same.
    assert found.mean == pytest.approx(0.7) and found.low < 0.3 and found.high == pytest.approx(0.7)
    level = [pool(seed, 0.5, share) for seed in (0, 1) for share in (0.2, 0.6)]
    found = estimate(level, 0, by_halving, repeats=10, resamples=50)
    assert (found.mean, found.low, found.high) == pytest.approx((0.4, 0.4, 0.4))
    assert estimate(PERFECT, 20, by_halving, repeats=20, resamples=20) == estimate(
        PERFECT, 20, by_halving, repeats=20, resamples=20
    )


def test_pools_are_the_candidates_that_were_tested(tmp_path: Path) -> None:
    """The last is the worst for its judges, but in the target the best."""
    results = bare_results("antmaze_u", {"astra": [0, 1, 2]}, {})
    with pytest.raises(
        BadInputError, match=r"those of antmaze_u without: give the recipe a table \[select\]"
    ):
        pools_of(results)
    candidates = [
        ranked(1, lower=0.75, predicted=0.8, target=0.29),
        ranked(2, lower=0.5, predicted=0.7, target=None),
        ranked(0, lower=0.25, predicted=0.3, target=1.0),
    ]
    assert pools_of(chosen_from(results, candidates)) == [
        Pool(1, 0.75, 0.8, 100, 29),
        Pool(0, 0.25, 0.3, 100, 100),
    ]
    with pytest.raises(BadInputError, match="tested in the target, found 1: run its recipe until evaluate"):
        pools_of(chosen_from(results, candidates[:2]))


def ranked(seed: int, **figures: float | None) -> Ranked:
    return Ranked.model_validate(
        {"row": "astra", "seed": seed, "judges": 2, "low": None, "high": None, **figures}
    )


def chosen_from(results: Results, candidates: list[Ranked]) -> Results:
    choice = Choice(judge="nas", episodes=4, shares_episodes=False, candidates=candidates)
    return results.model_copy(update={"choice": choice, "episodes": 100})


TOOL = Path(__file__).parents[1] / "tools/check_trials.py"


def test_the_tool_prints_a_table(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    candidates = [
        ranked(seed, lower=lower, predicted=lower, target=target)
        for seed, lower, target in ((0, 0.8, 0.75), (1, 0.7, 1.0), (2, 0.1, 0.0))
    ]
    found = chosen_from(bare_results("antmaze_u", {"astra": [0, 1, 2]}, {}), candidates)
    file.write_text(found.model_dump_json())
    given = ["--trials", "10", "--repeats", "20", "--resamples", "10"]
    command = [sys.executable, str(TOOL), str(file), *given]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "antmaze_u: 3 candidates, regret by trials" in shown
    assert "| 0 | 0.25 [" in shown and "| 10 | " in shown


def test_the_tool_tells_what_is_wrong_in_one_line(tmp_path: Path) -> None:
    command = [sys.executable, str(TOOL), str(tmp_path / "none.json")]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1 and "expected published results" in ended.stderr
    assert "Traceback" not in ended.stderr
