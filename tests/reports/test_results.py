import json
from pathlib import Path

import pytest
from fake_runs import line, results

from astra_data.core.errors import BadInputError
from astra_data.reports.choice import Candidate, Judgment
from astra_data.reports.results import (
    SIMULATED,
    TESTED,
    DatasetUse,
    Errors,
    Origin,
    TrainingFacts,
    elapsed_seconds,
    judged_horizon,
    merge,
    merged_origins,
    read_results,
    replaced,
    results_json,
    stage_seconds,
)
from astra_data.worlds.objective import SURVIVED_STEPS


def error(row: str, seed: int, simulator: str, *mean: float, horizons: tuple[int, ...] = (1, 10)) -> Errors:
    low, high = [0.5 * one for one in mean], [2 * one for one in mean]
    return Errors(
        row=row, seed=seed, simulator=simulator, quantity="x_m", horizons=[*horizons], mean=[*mean], low=low, high=high
    )


def judged(seed: int, episodes: int = 5) -> Judgment:
    return Judgment(judge="nas", episodes=episodes, candidates=[Candidate(row="nas", seed=seed, success={7: 0.5})])


def test_code_and_machine_stand_once_with_all_stages_that_ran_there() -> None:
    def origin(commit: str, *stages: str) -> Origin:
        return Origin(commit=commit, machine=None, packages={}, stages=[*stages])

    found = merged_origins([origin("a", "pair"), origin("b", "train"), origin("a", "train", "pair")])
    assert [(one.commit, one.stages) for one in found] == [("a", ["pair", "train"]), ("b", ["train"])]


def test_numbers_are_found_by_method_place_and_size() -> None:
    found = results(
        line("astra", 1, success=0.5),
        line("astra", 0, success=1.0),
        line("astra", 0, SIMULATED, success=0.25),
        line("astra", 0, percent=20, success=0.0),
        line("nas", 0, success=0.0),
        rows=("direct_transfer", "astra"),
        errors=[error("nas", 0, "raw", 1.0, 2.0).model_copy(update={"percent": 50})],  # where nothing is tested
    )
    assert found.values("astra", "success") == {0: 1.0, 1: 0.5}
    assert found.values("astra", "success", SIMULATED) == {0: 0.25}
    assert found.values("astra", "success", TESTED, 20) == {0: 0.0}
    assert (found.percents, found.seeds, found.tested()) == ([20, 100], [0, 1], ["astra"])
    summary = found.score_of("astra")
    assert summary and (summary.value, summary.seeds) == (0.75, 2) and found.summary("astra", "failed") is None


def test_the_interval_of_a_score_stays_within_what_it_can_be() -> None:
    steps = [line("astra", seed, steps=10.0 * seed) for seed in range(3)]
    found = results(*steps, scores=(SURVIVED_STEPS,)).score_of("astra")
    assert found and found.low is not None and found.low < 0
    shares = results(*(line("astra", seed, success=0.5 * seed) for seed in range(3))).score_of("astra")
    assert shares and (shares.low, shares.high) == (0.0, 1.0)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    training = TrainingFacts(row="astra", seed=0, steps=[1.0, 2.0], score=[float("nan"), 0.5])
    found = results(line("astra", 0, success=0.5), errors=[error("nas", 0, "raw", 1.0, 2.0)], trainings=[training])
    path = tmp_path / "r.json"
    path.write_text(results_json(found))
    assert read_results(path).model_dump_json() == found.model_dump_json()
    assert json.loads(path.read_text())["trainings"][0]["score"] == [None, 0.5]
    assert '    {"row": "astra", "seed": 0, "percent": 100, "where": "tested"' in path.read_text()
    path.write_text("{}")
    with pytest.raises(BadInputError, match="is not what the report writes"):
        read_results(path)
    with pytest.raises(BadInputError, match="found none"):
        read_results(tmp_path / "none.json")


def test_merging_loses_nothing_and_says_what_it_replaces() -> None:
    first = results(
        line("astra", 0, success=0.25),
        line("astra", 1, success=0.5),
        line("nas", 0, success=1.0),
        rows=("nas", "astra"),
        errors=[error("nas", 0, "raw", 1.0, 2.0)],
        judged=judged(0),
        command="run --seed 1\nrun --seed 0",
        user_code={"task": "a"},
    )
    later = line("astra", 1, success=0.75), line("astra", 2, success=1.0)
    more: dict[str, object] = {"judged": judged(1), "user_code": {"task": "b"}}
    second = results(*later, rows=("astra",), command="run --seed 2\nrun --seed 1", **more)
    merged = merge([first, second])
    assert merge([merged, first]).user_code == {"task": "a and b"}
    assert merged.judged and [one.seed for one in merged.judged.candidates] == [0, 1]
    assert merged.command.split("run --seed ")[1:] == ["1\n", "0\n", "2"]
    assert merged.rows == ("astra", "nas") and merged.values("astra", "success") == {0: 0.25, 1: 0.75, 2: 1.0}
    assert merged.values("nas", "success") == {0: 1.0} and merged.errors == first.errors
    assert replaced(first, second) == ["astra seed 1 (success 0.5, now 0.75)"] and replaced(first, first) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 9}, "got episodes 4 and 9"),
        ({"task": "u"}, "got task t and u"),
        ({"leg_scale": 1.5}, "got leg_scale 1.0 and 1.5"),
        ({"tested_in": "simulators"}, "got tested_in target and simulators"),
        ({"judged": judged(1, episodes=9)}, "got judges .*'episodes': 5.* and .*'episodes': 9"),
        (
            {"datasets": [DatasetUse(stage="pair", seed=0, version="1", content_hash="b")]},
            "pair seed 0 with content a and b",
        ),
    ],
)
def test_results_that_were_made_differently_are_not_merged(changes: dict[str, object], message: str) -> None:
    uses = [DatasetUse(stage="pair", seed=0, version="1", content_hash="a")]
    with pytest.raises(BadInputError, match=message):
        merge([results(datasets=uses, judged=judged(0)), results(**changes)])


def test_errors_are_averaged_over_seeds_where_all_know_them() -> None:
    found = results(
        errors=[
            *(error("nas", seed, "grounded", 1.0 + seed, 10.0) for seed in (0, 1)),
            *(error("nas", seed, "raw", 4.0, 40.0) for seed in (0, 1)),
            error("astra", 0, "grounded", 0.5, horizons=(1,)),
        ],
        rows=("nas",),
    )
    means = found.mean_errors()
    assert means.loc[("nas", "grounded", "x_m", 1)].tolist() == [1.5, 0.75, 3.0]
    assert set(means.index.get_level_values("horizon")) == {1} and found.groundings() == ["nas", "astra"]


@pytest.mark.parametrize(("horizons", "expected"), [((1, 10, 50), 10), ((1, 5, 20), 5), ((20, 50), 20)])
def test_simulators_are_judged_ten_steps_ahead_or_less(horizons: tuple[int, ...], expected: int) -> None:
    assert judged_horizon(horizons) == expected


def test_what_runs_at_once_takes_its_wall_time_once() -> None:
    found = results(
        line("a", 0, "train", wall_seconds=10.0, finished_at=110.0),  # 100 to 110
        line("a", 1, "train", wall_seconds=10.0, finished_at=115.0),  # 105 to 115
        line("b", 0, "train", wall_seconds=2.0, finished_at=109.0),
        line("b", 1, "evaluate", wall_seconds=5.0, finished_at=130.0),
        line("b", 2, "evaluate", wall_seconds=7.0),  # when is unknown
    )
    assert elapsed_seconds(found) == pytest.approx(15 + 5 + 7)
    assert stage_seconds(found, "wall_seconds") == {"train": 22.0, "evaluate": 12.0}
