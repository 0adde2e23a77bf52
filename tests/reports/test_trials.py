from collections.abc import Sequence
from itertools import product
from math import ceil
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

from astra_data.core.errors import BadInputError
from astra_data.reports.choice import Candidate, Judged, select_page
from astra_data.reports.trials import (
    LEAST_TRIALS,
    PSEUDO_TRIALS,
    TRIALS,
    Attempt,
    TrialRound,
    TrialsFile,
    Tried,
    halve,
    least_trials,
    posterior,
    read_trials,
    widest_field,
)

CANDIDATES = [
    Candidate(row=row, seed=1, success={0: lower, 2: lower}) for row, lower in (("astra", 0.5), ("nas", 0.25))
]
JUDGED = Judged(judge="nas", episodes=5, candidates=CANDIDATES)
FIRST = TrialRound(
    trials=2,
    candidates=[("astra", 1), ("nas", 1)],
    tried=[Tried(row="astra", seed=1, success=[0, 1]), Tried(row="nas", seed=1, success=[1, 1])],
)
BEGUN = TrialsFile(trials=9, field=2, pseudo_trials=4, rounds=[FIRST])


def test_trials_are_read_as_they_were_written(tmp_path: Path) -> None:
    assert read_trials(tmp_path / TRIALS) is None
    (tmp_path / TRIALS).write_text(BEGUN.model_dump_json())
    assert read_trials(tmp_path / TRIALS) == BEGUN and BEGUN.spent == 4
    (tmp_path / TRIALS).write_text("{}")
    with pytest.raises(BadInputError, match="trials"):
        read_trials(tmp_path / TRIALS)


def test_the_page_says_who_was_tried_how_often_with_what_success() -> None:
    assert "Trials in the target" not in select_page("cart", JUDGED)
    page = select_page("cart", JUDGED, BEGUN)
    assert "## Trials in the target\n\nNot finished: run the same command again. 4 of 9 episodes" in page
    assert "| 1 | ASTRA | 1 | 1 | 2 | 0.50 |" in page and "| 1 | NAS | 1 | 2 | 2 | 0.50 |" in page
    second = TrialRound(trials=2, candidates=[("nas", 1)], tried=[Tried(row="nas", seed=1, success=[1, 1])])
    done = BEGUN.model_copy(update={"rounds": [FIRST, second], "chosen": ("nas", 1), "mean": 0.625})
    page = select_page("cart", JUDGED, done)
    assert (
        "**NAS, seed 1**: success 0.62, estimated from the prediction and the trials. 6 of 9 episodes" in page
    )
    assert "| 2 | NAS | 1 | 2 | 2 | 0.62 |" in page  # (4 · 0.25 + 4) / (4 + 4)


def test_the_prior_of_trials_is_the_lower_quartile() -> None:
    one = Candidate(row="astra", seed=1, success={0: 0.0, 2: 1.0})
    judged = Judged(judge="nas", episodes=5, candidates=[one])
    tried = TrialRound(
        trials=2, candidates=[("astra", 1)], tried=[Tried(row="astra", seed=1, success=[0, 1])]
    )
    page = select_page("cart", judged, BEGUN.model_copy(update={"rounds": [tried]}))
    assert "| 1 | ASTRA | 1 | 1 | 2 | 0.33 |" in page  # (4 · 0.25 + 1) / (4 + 2)


def drawn(success: Sequence[float], rng: np.random.Generator) -> Attempt:
    return lambda _, those, each: [int(rng.binomial(each, success[one])) for one in those]


def certain(success: Sequence[int]) -> Attempt:
    return lambda _, those, each: [each * success[one] for one in those]


def refused(*_: object) -> list[int]:
    raise AssertionError("nothing is to be tried")


def test_without_trials_the_prediction_decides() -> None:
    found = halve([0.2, 0.9], 0, refused)  # the first is preferred, whatever the figures
    assert found.chosen == 0 and found.rounds == () and found.mean == pytest.approx(0.2)
    assert halve([0.5], 100, refused).chosen == 0


def test_rounds_share_the_trials_and_so_do_their_candidates() -> None:
    found = halve([0.9, 0.8, 0.7, 0.6, 0.5], 60, certain([0, 0, 0, 1, 1]))
    assert found.rounds == (((0, 1, 2, 3, 4), 4), ((3, 4, 0), 6), ((3, 4), 11))
    assert sum(len(those) * each for those, each in found.rounds) == 60
    assert found.chosen == 3 and found.mean == pytest.approx((4 * 0.6 + 21) / (4 + 21))


def test_the_field_is_as_wide_as_the_trials_allow() -> None:
    assert least_trials(1) == 0 and least_trials(2) == 2 * LEAST_TRIALS
    assert least_trials(5) == LEAST_TRIALS * (5 + 3 + 2)
    assert widest_field(90, 0) == widest_field(90, 3) == 1
    assert widest_field(90, 20) == 5 and widest_field(3, 1000) == 3
    for field, trials in product(range(2, 20), range(4, 150)):
        if trials < least_trials(field):
            continue
        found = halve([0.5] * field, trials, certain([1] * field), field=field)
        assert all(each >= LEAST_TRIALS for _, each in found.rounds)
        assert sum(len(those) * each for those, each in found.rounds) <= trials
        assert len(found.rounds[0][0]) == field
        for (those, _), (after, _) in zip(found.rounds, found.rounds[1:], strict=False):
            assert len(after) == ceil(len(those) / 2)


def test_ties_go_to_what_the_prediction_prefers() -> None:
    for success in (0, 1):
        assert halve([0.5] * 4, 40, certain([success] * 4)).chosen == 0


def test_trials_outweigh_a_wrong_prediction_and_a_prediction_counts_as_a_few() -> None:
    assert posterior(0.75, 0, 0) == 0.75 and posterior(1.0, 0, PSEUDO_TRIALS) == 0.5
    assert halve([1.0, 0.0], 4 * PSEUDO_TRIALS, certain([0, 1])).chosen == 1
    # With as many trials as the prediction counts as, a full swing is a tie; with fewer, it prevails.
    assert halve([1.0, 0.0], 2 * PSEUDO_TRIALS, certain([0, 1])).chosen == 0


@pytest.mark.parametrize("trials", [8, 20, 61])
def test_the_better_of_two_is_found_as_often_as_the_binomial_says(trials: int) -> None:
    priors, success, each = (0.7, 0.4), (0.4, 0.6), trials // 2
    counts = product(range(each + 1), repeat=2)
    better = [(a, b) for a, b in counts if posterior(0.4, b, each) > posterior(0.7, a, each)]
    expected = sum(binom.pmf(a, each, success[0]) * binom.pmf(b, each, success[1]) for a, b in better)
    rng = np.random.default_rng(0)
    found = [halve(priors, trials, drawn(success, rng)).chosen for _ in range(4000)]
    assert np.mean(found) == pytest.approx(expected, abs=0.025)
    assert 0.05 < expected < 0.99


def test_the_best_of_four_is_found_as_often_as_all_outcomes_say() -> None:
    """Two rounds: two trials each, then four each for the better two; every outcome, weighed."""
    priors, success = (0.6, 0.5, 0.5, 0.4), (0.2, 0.3, 0.5, 0.8)
    expected = 0.0
    for first in product(range(3), repeat=4):
        weight = float(np.prod(binom.pmf(first, 2, success)))
        means = [(4 * prior + count) / 6 for prior, count in zip(priors, first, strict=True)]
        one, other = sorted(range(4), key=lambda n: (-means[n], n))[:2]
        for second in product(range(5), repeat=2):
            chance = binom.pmf(second[0], 4, success[one]) * binom.pmf(second[1], 4, success[other])
            ends = [
                (4 * priors[n] + first[n] + more) / 10 for n, more in zip((one, other), second, strict=True)
            ]
            tied, wins = ends[0] == ends[1], ends[0] > ends[1]
            chosen = min(one, other) if tied else one if wins else other
            expected += weight * chance * (chosen == 3)
    rng = np.random.default_rng(0)
    found = [halve(priors, 16, drawn(success, rng)).chosen == 3 for _ in range(4000)]
    assert np.mean(found) == pytest.approx(expected, abs=0.025)
