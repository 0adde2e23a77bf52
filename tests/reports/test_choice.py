import json
from pathlib import Path
from statistics import fmean

import pytest

from astra_data.core.errors import BadInputError
from astra_data.reports.choice import Candidate, Choice, Judged, choice_of, read_judged
from astra_data.reports.statistics import mean_interval

Line = tuple[str, int, float, float | None]


def judged(*lines: Line, judges: int = 1) -> Judged:
    candidates = [
        Candidate(row=row, seed=seed, success={90 + n: lower for n in range(judges)})
        for row, seed, lower, _ in lines
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
    assert liked_by_one.predicted > steady.predicted and liked_by_one.lower < steady.lower
    assert Candidate(row="a", seed=0, success={1: 0.0, 2: 0.4}).lower == pytest.approx(0.1)
    found = Judged(judge="nas", episodes=5, candidates=[level, liked_by_one, steady])
    assert found.ranked() == [steady, liked_by_one, level]


def test_an_interval_takes_judges_as_the_sampling_unit_and_needs_three() -> None:
    success = {1: 0.1, 2: 0.9, 3: 0.5}
    candidates = [
        Candidate(row="a", seed=0, success=success),
        Candidate(row="a", seed=1, success={judge: success[judge] for judge in (1, 2)}),
    ]
    found = choice_of(Judged(judge="nas", episodes=100, candidates=candidates), None, measured={})
    assert found is not None
    three, two = sorted(found.candidates, key=lambda one: one.seed)
    assert (three.predicted.low, three.predicted.high) == mean_interval(
        [0.1, 0.9, 0.5], limit=1.0, trials=100
    )
    assert (two.predicted.low, two.predicted.high) == (None, None)


def test_a_choice_is_worth_its_rank_correlation_and_its_regret() -> None:
    found = choice(*A, *B)
    # Within a the order is right, within b it is reversed; between rows nothing counts.
    assert found.rank_correlation is not None and found.rank_correlation.value == pytest.approx(0.0)
    assert found.regret == pytest.approx(0.1)
    assert found.random_regret == pytest.approx(0.4 - fmean(target or 0.0 for *_, target in A + B))
    right = choice(*A).rank_correlation
    assert right is not None and (right.value, right.low, right.high) == pytest.approx((1, 1, 1))


def test_predictions_are_compared_row_by_row() -> None:
    found = choice(("a", 0, 0.9, 0.7), ("a", 1, 0.1, 0.2), ("b", 0, 0.5, 0.9)).calibration
    assert found["a"] == pytest.approx((2, 0.05, 0.15))
    assert found["b"] == pytest.approx((1, -0.4, 0.4))


def test_the_mean_over_judges_is_what_is_compared() -> None:
    one = Candidate(row="a", seed=0, success={1: 0.0, 2: 1.0})
    of = Judged(judge="nas", episodes=5, candidates=[one])
    found = choice_of(of, None, measured={("a", 0): 0.5})
    assert found is not None and found.calibration["a"] == (1, 0.0, 0.0) and found.candidates[0].lower == 0.25


def test_what_cannot_be_known_is_missing_with_the_reason() -> None:
    untested = choice(("a", 0, 0.9, None))
    assert untested.regret is None and untested.calibration == {}
    assert untested.missing == {}
    few = choice(*A[:2], B[0])
    assert few.rank_correlation is None
    assert few.missing["rank_correlation"] == "no method has 3 tested seeds"
    level = choice(("a", 0, 0.9, 0.3), ("a", 1, 0.9, 0.2), ("a", 2, 0.9, 0.1))
    assert level.missing["rank_correlation"] == "in no method do both sides vary"
    first = choice(("a", 0, 0.9, None), ("a", 1, 0.8, 0.2))
    assert first.regret is None and first.random_regret == 0.0
    assert first.missing["regret"] == "the chosen policy was not tested in the target"
    assert choice(*A).missing == {}


def test_the_target_has_no_say_in_the_ranking() -> None:
    reversed_there: list[Line] = [(row, seed, lower, 1 - lower) for row, seed, lower, _ in A + B]
    orders = [[(one.row, one.seed) for one in choice(*lines).candidates] for lines in (A + B, reversed_there)]
    assert orders[0] == orders[1] == [(row, seed) for row, seed, *_ in A + B]


def test_what_the_stage_wrote_is_read(tmp_path: Path) -> None:
    assert read_judged(tmp_path) is None
    (tmp_path / "select").mkdir()
    file = tmp_path / "select/select.json"
    file.write_text(judged(*A).model_dump_json())
    assert read_judged(tmp_path) == judged(*A)
    file.write_text(json.dumps({"judge": "nas", "episodes": 5, "candidates": []}))
    with pytest.raises(BadInputError, match="candidates"):
        read_judged(tmp_path)


def test_level_quartiles_are_told_apart_by_the_mean() -> None:
    candidates = [
        Candidate(row="a", seed=seed, success=dict(enumerate([0.2, 0.2, 0.2, 0.2, most])))
        for seed, most in enumerate((0.4, 0.6, 0.8))
    ]
    of = Judged(judge="nas", episodes=5, candidates=candidates)
    measured = {("a", seed): 0.1 * seed for seed in range(3)}
    found = choice_of(of, None, measured=measured)
    assert found is not None and found.rank_correlation is not None
    assert found.rank_correlation.value == pytest.approx(1.0)


def test_a_row_with_enough_seeds_that_does_not_vary_is_not_said_to_have_too_few() -> None:
    level: list[Line] = [("a", seed, 0.9, 0.1 * seed) for seed in range(3)]
    found = choice(*level, ("b", 0, 0.5, 0.2))
    assert found.missing["rank_correlation"] == "in no method do both sides vary"
