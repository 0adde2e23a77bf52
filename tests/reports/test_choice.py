import json
from collections.abc import Sequence
from itertools import pairwise, product
from math import ceil
from pathlib import Path
from statistics import fmean

import pytest

from astra_data.core.errors import BadInputError
from astra_data.reports.artifacts import read_json
from astra_data.reports.choice import (
    LEAST_TRIALS,
    PSEUDO_TRIALS,
    TRIALS,
    Attempt,
    Candidate,
    Choice,
    Judged,
    TrialRound,
    Trials,
    Tried,
    advice,
    choice_of,
    halve,
    least_trials,
    posterior,
    select_page,
    standings,
    widest_field,
)
from astra_data.reports.statistics import interval, success_rate, summarize

Line = tuple[str, int, float, float | None]


def judged(*lines: Line, judges: int = 1) -> Judged:
    candidates = [
        Candidate(row=row, seed=seed, success={90 + n: lower for n in range(judges)}) for row, seed, lower, _ in lines
    ]
    return Judged(judge="nas", episodes=5, candidates=candidates)


def choice(*lines: Line, judges: int = 1) -> Choice:
    measured = {(row, seed): target for row, seed, _, target in lines if target is not None}
    found = choice_of(judged(*lines, judges=judges), None, measured=measured)
    assert found is not None
    return found


A: list[Line] = [("a", 0, 0.9, 0.3), ("a", 1, 0.8, 0.2), ("a", 2, 0.7, 0.1)]
B: list[Line] = [("b", 0, 0.6, 0.1), ("b", 1, 0.5, 0.2), ("b", 2, 0.4, 0.4)]


def test_the_lower_quartile_is_what_counts_then_the_mean() -> None:
    liked_by_one = Candidate(row="a", seed=0, success={1: 1.0, 2: 0.2, 3: 0.2, 4: 0.2, 5: 0.2})
    steady = Candidate(row="a", seed=1, success={0: 0.3, 2: 0.3, 3: 0.3, 4: 0.3, 5: 0.3})
    level = Candidate(row="a", seed=2, success={0: 0.2, 1: 0.2})
    assert liked_by_one.predicted == pytest.approx(0.36) and steady.predicted == pytest.approx(0.3)
    assert liked_by_one.lower < steady.lower
    assert Candidate(row="a", seed=0, success={1: 0.0, 2: 0.4}).lower == pytest.approx(0.1)
    alike = level.model_copy(update={"seed": 3})
    found = Judged(judge="nas", episodes=5, candidates=[level, liked_by_one, steady, alike])
    assert found.ranked() == [steady, liked_by_one, level, alike]


def test_an_interval_takes_judges_as_the_sampling_unit_and_needs_three() -> None:
    three, two = (Candidate(row="a", seed=0, success=of) for of in ({1: 0.1, 2: 0.9, 3: 0.5}, {1: 0.1, 2: 0.9}))
    found = Judged(judge="nas", episodes=100, candidates=[three])
    assert found.estimate(three) == summarize([0.1, 0.9, 0.5], limit=1.0, trials=100)
    assert (found.estimate(two).low, found.estimate(two).high) == (None, None)


def test_a_choice_is_worth_its_regret() -> None:
    found = choice(*A, *B)
    assert found.regret == pytest.approx(0.1)
    assert found.random_regret == pytest.approx(0.4 - fmean(target or 0.0 for *_, target in A + B))


def test_predictions_are_compared_row_by_row() -> None:
    found = choice(("a", 0, 0.9, 0.7), ("a", 1, 0.1, 0.2), ("b", 0, 0.5, 0.9)).calibration
    assert found["a"] == pytest.approx((2, 0.05, 0.15)) and found["b"] == pytest.approx((1, -0.4, 0.4))


def test_what_is_not_tested_is_worth_nothing_known() -> None:
    untested = choice(("a", 0, 0.9, None))
    assert untested.regret is None and untested.calibration == {}
    first = choice(("a", 0, 0.9, None), ("a", 1, 0.8, 0.2))
    assert first.regret is None and first.random_regret == 0.0


def test_the_target_has_no_say_in_the_ranking() -> None:
    reversed_there: list[Line] = [(row, seed, lower, 1 - lower) for row, seed, lower, _ in A + B]
    orders = [[(one.row, one.seed) for one in choice(*lines).candidates] for lines in (A + B, reversed_there)]
    assert orders[0] == orders[1] == [(row, seed) for row, seed, *_ in A + B]


def test_a_choice_has_candidates(tmp_path: Path) -> None:
    file = tmp_path / "select.json"
    file.write_text(json.dumps({"judge": "nas", "episodes": 5, "candidates": []}))
    with pytest.raises(BadInputError, match="candidates"):
        read_json(Judged, file)


CANDIDATES = [
    Candidate(row="astra", seed=1, success={0: 0.5, 2: 0.5}),
    Candidate(row="nas", seed=1, success={0: 0.0, 2: 1.0}),  # with a lower quartile of 0.25
    Candidate(row="rma", seed=1, success={0: 0.9}),
]
JUDGED = Judged(judge="nas", episodes=5, candidates=CANDIDATES)
FIRST = TrialRound(
    trials=2,
    candidates=[("astra", 1), ("nas", 1)],
    tried=[Tried(row="astra", seed=1, success=[0, 1]), Tried(row="nas", seed=1, success=[1, 1])],
)
BEGUN = Trials(trials=9, field=2, pseudo_trials=4, rounds=[FIRST])


def test_the_page_says_who_was_tried_how_often_with_what_success(tmp_path: Path) -> None:
    (tmp_path / TRIALS).write_text(BEGUN.model_dump_json())
    assert read_json(Trials, tmp_path / TRIALS) == BEGUN and BEGUN.spent == 4
    assert "Trials in the target" not in select_page("cart", JUDGED)
    page = select_page("cart", JUDGED, BEGUN)
    ahead = "ASTRA, seed 1 is ahead, with a success of 0.50 [0.09, 0.91]. NAS, seed 1, with 1.00 [0.34, 1.00]"
    assert f"target\n\nNot finished: run the same command again. {ahead}, may be as good: go on. 4 of 9 epis" in page
    assert "| 1 | ASTRA | 1 | 1 | 2 | 0.50 | 0.50 [0.09, 0.91] |" in page
    assert "| 1 | NAS | 1 | 2 | 2 | 0.50 | 1.00 [0.34, 1.00] |" in page
    second = TrialRound(trials=2, candidates=[("nas", 1)], tried=[Tried(row="nas", seed=1, success=[1, 1])])
    done = BEGUN.model_copy(update={"rounds": [FIRST, second], "chosen": ("nas", 1), "mean": 0.625})
    done = done.model_copy(update={"rate": (1.0, 0.51, 1.0)})
    page = select_page("cart", JUDGED, done)
    assert "**NAS, seed 1**: success 1.00 [0.51, 1.00]. 6 of 9 episodes" in page
    assert "| 2 | NAS | 1 | 2 | 2 | 0.62 | 1.00 [0.51, 1.00] |" in page  # (4 · 0.25 + 4) / (4 + 4)
    assert "| 1 | NAS | 1 | 2 | 2 | 0.50 | 1.00 [0.34, 1.00] |" in page  # as it was then
    assert "control variate" not in page
    assert "(control variate)" in select_page("cart", JUDGED, done.model_copy(update={"by_hand": True}))


def test_advice_is_to_go_on_until_the_best_is_above_all_others() -> None:
    def after(astra: list[int], nas: list[int], trials: int = 99, **more: list[float]) -> str:
        tried = [Tried(row="astra", seed=1, success=astra, **more), Tried(row="nas", seed=1, success=nas)]
        of = TrialRound(trials=9, candidates=[("astra", 1), ("nas", 1)], tried=tried)
        return advice(JUDGED, BEGUN.model_copy(update={"rounds": [of], "trials": trials}))

    assert after([], []) == "Nothing is tried yet."
    assert after([1], []) == (
        "ASTRA, seed 1 is ahead, with a success of 1.00 [0.21, 1.00]; others of this round are still to be tried."
    )
    assert after([1] * 9, [0] * 9).endswith(
        "success of 1.00 [0.70, 1.00]. You can stop: all others of this round are below, at 0.30 or less."
    )
    # NAS has the better trials; with its lower quartile of 0.25 as four more, and 0.5 for ASTRA.
    assert after([1, 0], [1] * 9).startswith("NAS, seed 1 is ahead, with a success of 1.00 [0.70, 1.00]. ASTRA, seed 1")
    assert after([1, 0], [1] * 9).endswith("may be as good: go on.")
    assert after([1, 0], [1] * 9, trials=11).endswith("may be as good.")
    # The rival is who may be best: not RMA, which was predicted to be.
    won = {"astra": [1] * 9, "nas": [1, 0], "rma": [0] * 3}
    tried = [Tried(row=row, seed=1, success=of) for row, of in won.items()]
    three = TrialRound(trials=9, candidates=[(row, 1) for row in won], tried=tried)
    assert "NAS, seed 1, with 0.50" in advice(JUDGED, BEGUN.model_copy(update={"rounds": [three]}))
    # The prediction, 0.5 in ten episodes, explains the two failures of trials that it knows to be hard.
    told = success_rate([1, 0, 1, 0], [0.9, 0.1, 0.9, 0.1], 0.5, 10)
    assert interval(told) in after([1, 0, 1, 0], [0], predicted=[0.9, 0.1, 0.9, 0.1]) != after([1, 0, 1, 0], [0])


def test_a_candidate_stands_by_all_its_trials_so_far() -> None:
    tried = (Tried(row="nas", seed=1, success=[of, 1], predicted=[0.1, told]) for of, told in ((1, 0.8), (0, 0.9)))
    rounds = [TrialRound(trials=2, candidates=[("nas", 1)], tried=[one]) for one in tried]
    found = standings(JUDGED, None, rounds)
    assert [*found] == [("nas", 1)] and found["nas", 1].mean == (4 * 0.25 + 3) / 8
    assert found["nas", 1].rate == success_rate([1, 1, 0, 1], [0.1, 0.8, 0.1, 0.9], 0.5, 10)
    assert [*standings(JUDGED, None, [FIRST])] == [("astra", 1), ("nas", 1)]


Rounds = list[tuple[tuple[int, ...], int]]


def certain(success: Sequence[int], rounds: Rounds | None = None) -> Attempt:
    """Succeed always or never, and note the candidates of each round with the trials of each in `rounds`."""
    noted: Rounds = [] if rounds is None else rounds

    def attempt(number: int, those: tuple[int, ...], each: int) -> list[int]:
        assert number == len(noted)
        noted.append((those, each))
        return [each * success[one] for one in those]

    return attempt


def refused(*_: object) -> list[int]:
    raise AssertionError("nothing is to be tried")


def test_rounds_share_the_trials_and_so_do_their_candidates() -> None:
    rounds: Rounds = []
    found = halve([0.9, 0.8, 0.7, 0.6, 0.5], 60, certain([0, 0, 0, 1, 1], rounds))
    assert rounds == [((0, 1, 2, 3, 4), 4), ((3, 4, 0), 6), ((3, 4), 11)]
    assert sum(len(those) * each for those, each in rounds) == 60
    assert found == pytest.approx((3, (4 * 0.6 + 21) / (4 + 21)))


def test_the_field_is_as_wide_as_the_trials_allow() -> None:
    assert least_trials(1) == 0 and least_trials(2) == 2 * LEAST_TRIALS
    assert least_trials(5) == LEAST_TRIALS * (5 + 3 + 2) and widest_field(90, 0) == widest_field(90, 3) == 1
    assert widest_field(90, 20) == 5 and widest_field(3, 1000) == 3
    for field, trials in product(range(2, 20), range(4, 150)):
        if trials < least_trials(field):
            continue
        rounds: Rounds = []
        halve([0.5] * field, trials, certain([1] * field, rounds), field=field)
        assert all(each >= LEAST_TRIALS for _, each in rounds)
        assert sum(len(those) * each for those, each in rounds) <= trials and len(rounds[0][0]) == field
        for (those, _), (after, _) in pairwise(rounds):
            assert len(after) == ceil(len(those) / 2)


def test_ties_go_to_what_the_prediction_prefers() -> None:
    for success in (0, 1):
        assert halve([0.5] * 4, 40, certain([success] * 4))[0] == 0
    # Without trials, the first is preferred, whatever the figures.
    assert halve([0.2, 0.9], 0, refused) == pytest.approx((0, 0.2))


def test_trials_outweigh_a_wrong_prediction_and_a_prediction_counts_as_a_few() -> None:
    assert posterior(0.75, 0, 0) == 0.75 and posterior(1.0, 0, PSEUDO_TRIALS) == 0.5
    assert halve([1.0, 0.0], 4 * PSEUDO_TRIALS, certain([0, 1]))[0] == 1
    # With as many trials as the prediction counts as, a full swing is a tie; with fewer, it prevails.
    assert halve([1.0, 0.0], 2 * PSEUDO_TRIALS, certain([0, 1]))[0] == 0
