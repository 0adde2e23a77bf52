"""What is named as the row to deploy, in toy results and in published ones."""

import json
from pathlib import Path

import pytest
from fake_runs import SEEDS, FakeRecipe, write_choice, write_runs

from astra_data.reports.assembly import assemble
from astra_data.reports.comparing import summarized
from astra_data.reports.files import read_published
from astra_data.reports.schema import Choice, Ranked, Results
from astra_data.reports.statistics import Summary, share_interval
from astra_data.reports.verdict import Verdict, _ends, verdict_of

PUBLISHED = Path(__file__).parents[2] / "recipes/results"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return made(tmp_path_factory.mktemp("verdict"))


def made(parent: Path, *, select: bool = False, seeds: tuple[int, ...] = SEEDS) -> Results:
    root = write_runs(parent)
    if select:
        write_choice(root)
    return assemble(FakeRecipe("toy", seeds=seeds), root=root, command="", replicates=100)


def with_success(results: Results, **shares: list[float]) -> Results:
    rows = {
        name: summarized(results.methods[name].model_copy(update={"success": of}), 100)
        for name, of in shares.items()
    }
    return results.model_copy(update={"methods": results.methods | rows})


def sentence(verdict: Verdict) -> str:
    """Return the verdict as it is read, with plain spaces."""
    return f"{verdict.opening} {verdict.title}{verdict.reason}".replace("\N{NO-BREAK SPACE}", " ")


def test_without_a_choice_it_is_the_best_mean_of_no_reference(results: Results) -> None:
    # The follower has 1, ASTRA+ a mean of 11/12, the floor and ASTRA less.
    verdict = verdict_of(results)
    assert (verdict.row, verdict.opening, verdict.title) == ("astra_plus", "Deploy", "ASTRA+")
    assert sentence(verdict).startswith(
        "Deploy ASTRA+: success 0.92 ± 0.14 in the target (3 seeds with 4 episodes each; "
    )
    assert "This row has the best mean over seeds; the select stage chose no policy." in verdict.reason
    labels = [(fact.label, fact.value) for fact in verdict.facts]
    assert labels == [
        ("ASTRA+", "0.92 ± 0.14"),
        ("Direct transfer (floor)", "0.17 ± 0.14"),
        ("Careful follower (ceiling)", "1.00 ± 0.00"),
    ]
    few = "are compared over only 3 seeds: equal rows may differ as much by chance."
    assert verdict.remarks == [f"ASTRA+ and Direct transfer {few}"]


def test_the_choice_of_select_comes_before_the_best_mean(tmp_path: Path) -> None:
    verdict = verdict_of(made(tmp_path, select=True))
    assert (verdict.row, verdict.title) == ("astra", "ASTRA, seed 2")
    # Wilson's interval of 3 of 4 episodes.
    assert sentence(verdict).startswith(
        "Deploy ASTRA, seed 2. Its success, predicted without the target, is 1.00 "
        "(95 % interval 1.00 to 1.00); measured in the target, it is 0.75 (95 % interval 0.30 to 0.95) "
        "over 4 episodes. The select stage chose it from 6 policies."
    )
    assert any(
        remark.startswith("By the mean over seeds, ASTRA+ is ahead: success 0.92")
        for remark in verdict.remarks
    )
    assert any("better in the target by 0.25" in remark for remark in verdict.remarks)
    assert [fact.value for fact in verdict.facts[:3]] == ["1.00", "0.75", "0.50 ± 0.25"]


@pytest.mark.parametrize("floor", [[1.0, 1.0, 1.0], [1.0, 0.75, 1.0]])
def test_a_floor_that_is_as_good_is_told_first_and_not_deployed(results: Results, floor: list[float]) -> None:
    verdict = verdict_of(with_success(results, direct_transfer=floor))
    assert verdict.row == "astra_plus"
    assert sentence(verdict).startswith(
        "No gain over the floor: Direct transfer does as well or better. Of the other rows, deploy ASTRA+: "
    )
    less = verdict_of(with_success(results, direct_transfer=[0.75, 0.75, 1.0]))
    assert less.opening == "Deploy"
    assert any("intervals of ASTRA+ and Direct transfer overlap" in remark for remark in less.remarks)


def candidate(row: str, seed: int, predicted: float) -> Ranked:
    return Ranked(
        row=row, seed=seed, judges=2, lower=predicted, predicted=predicted, low=None, high=None, target=None
    )


def test_a_choice_of_a_ceiling_or_of_what_is_untested_is_passed_over(results: Results) -> None:
    candidates = [candidate("nas", 0, 0.9), candidate("follower", 1, 0.8), candidate("astra", 2, 0.7)]
    withheld = {"interval": "fewer than 3 judges"}
    choice = Choice(
        judge="nas", episodes=4, shares_episodes=True, candidates=candidates, regret=0.3, withheld=withheld
    )
    verdict = verdict_of(results.model_copy(update={"choice": choice}))
    assert verdict.title == "ASTRA, seed 2"
    assert "is 0.70 (interval withheld); it was not measured in the target. " in verdict.reason
    assert verdict.remarks[:2] == [
        "select ranks NAS, seed 0 higher, but it has not been tested yet.",
        "select ranks Careful follower, seed 1 higher, but it belongs to a reference row (ceiling).",
    ]
    assert "Withheld for the choice: interval (fewer than 3 judges)." in verdict.remarks
    assert any("All seeds have the same episodes" in remark for remark in verdict.remarks)
    # The regret is that of the first candidate.
    assert not any("regret" in remark for remark in verdict.remarks)
    assert verdict.facts[1].value == "-"


def test_a_chosen_policy_of_the_floor_is_the_one_to_deploy(
    results: Results,
) -> None:
    candidates = [candidate("direct_transfer", 1, 0.8), candidate("astra", 2, 0.7)]
    choice = Choice(judge="nas", episodes=4, shares_episodes=False, candidates=candidates)
    verdict = verdict_of(results.model_copy(update={"choice": choice}))
    assert (verdict.row, verdict.title) == ("direct_transfer", "Direct transfer, seed 1")
    assert verdict.opening == "No gain over the floor: the policy to deploy is"
    assert [fact.label for fact in verdict.facts].count("Direct transfer (floor)") == 1
    assert verdict.remarks[0].startswith(
        "By the mean over seeds, ASTRA+ is ahead: success 0.92 ± 0.14 in the"
    )
    assert not any("overlap" in remark or "compared over only" in remark for remark in verdict.remarks)


def test_no_row_is_ahead_of_a_chosen_floor_that_is_better(results: Results) -> None:
    candidates = [candidate("direct_transfer", 1, 0.8), candidate("astra", 2, 0.1)]
    choice = Choice(judge="nas", episodes=4, shares_episodes=False, candidates=candidates)
    verdict = verdict_of(results.model_copy(update={"choice": choice, "tested_in": "simulators"}))
    assert verdict.title == "Direct transfer, seed 1"
    assert not any("ahead" in remark for remark in verdict.remarks)


def test_where_all_are_predicted_to_fail_none_is_deployed(results: Results) -> None:
    candidates = [candidate("astra", 1, 0.0), candidate("astra", 2, 0.0)]
    choice = Choice(judge="nas", episodes=4, shares_episodes=False, candidates=candidates)
    verdict = verdict_of(results.model_copy(update={"choice": choice}))
    assert verdict.opening == "Deploy none: all are predicted to fail. The first in the ranking is"
    assert verdict.remarks[0] == "2 policies, including this one, tie in the ranking."
    candidates = [candidate("astra", 1, 0.1), candidate("astra", 2, 0.0)]
    verdict = verdict_of(
        results.model_copy(update={"choice": choice.model_copy(update={"candidates": candidates})})
    )
    assert verdict.opening == "Deploy" and not any(
        "tie in the ranking" in remark for remark in verdict.remarks
    )


def test_a_choice_among_policies_of_the_floor_alone_is_no_error(results: Results) -> None:
    choice = Choice(
        judge="nas", episodes=4, shares_episodes=False, candidates=[candidate("direct_transfer", 0, 0.4)]
    )
    verdict = verdict_of(results.model_copy(update={"choice": choice, "tested_in": "simulators"}))
    assert verdict.title == "Direct transfer, seed 0"
    assert not any("ahead" in remark for remark in verdict.remarks)


def test_without_a_target_rows_are_compared_by_what_is_predicted(results: Results) -> None:
    """Simulators show no failures: the floor has 1 there, and judges say 0.1."""
    candidates = [
        *(candidate("astra", 1, 0.9), candidate("astra_plus", 0, 0.8), candidate("astra_plus", 1, 0.8)),
        *(
            candidate("astra", 0, 0.5),
            candidate("direct_transfer", 0, 0.0),
            candidate("direct_transfer", 1, 0.2),
        ),
    ]
    choice = Choice(judge="nas", episodes=4, shares_episodes=False, candidates=candidates)
    shown = with_success(results, direct_transfer=[1.0, 1.0, 1.0], astra=[0.5, 0.5, 0.5])
    untested = shown.model_copy(update={"choice": choice, "tested_in": "simulators"})
    verdict = verdict_of(untested)
    assert (verdict.opening, verdict.title) == ("Deploy", "ASTRA, seed 1")
    unfinished = choice.model_copy(update={"candidates": [candidate("nas", 0, 1.0), *candidates]})
    assert verdict_of(untested.model_copy(update={"choice": unfinished})).title == "ASTRA, seed 1"
    assert "Predicted success of Direct transfer: 0.10, the mean over its seeds." in verdict.remarks
    assert "By the mean over seeds, ASTRA+ is ahead: predicted success 0.80." in verdict.remarks
    assert not any("overlap" in remark for remark in verdict.remarks)
    assert next(fact for fact in verdict.facts if fact.label == "ASTRA").note.startswith("success in ")
    as_good = choice.model_copy(
        update={"candidates": [*candidates[:4], candidate("direct_transfer", 0, 0.8)]}
    )
    assert verdict_of(untested.model_copy(update={"choice": as_good})).opening.startswith("No gain over the")
    # Rows that nobody judged are not compared: their figures are of simulators.
    alone = verdict_of(
        untested.model_copy(update={"choice": choice.model_copy(update={"candidates": candidates[:1]})})
    )
    assert (alone.opening, alone.title) == ("Deploy", "ASTRA, seed 1")
    assert "Not judged, so not compared: Direct transfer, ASTRA+." in alone.remarks
    assert not any("ahead" in remark or "overlap" in remark for remark in alone.remarks)
    # In the target it is measured, and what was predicted is no matter.
    assert verdict_of(shown.model_copy(update={"choice": choice})).opening.startswith(
        "No gain over the floor"
    )
    assert verdict_of(untested.model_copy(update={"choice": None})).opening.startswith(
        "No gain over the floor"
    )


def test_the_interval_is_of_whole_episodes(results: Results) -> None:
    """0.29 times 100 is a little less than 29."""
    assert _ends(results.model_copy(update={"episodes": 100}), 0.29) == share_interval(29, 100)


def test_a_single_seed_has_no_interval(tmp_path: Path) -> None:
    verdict = verdict_of(made(tmp_path, seeds=(1,)))
    assert sentence(verdict).startswith(
        "Deploy ASTRA+: success 0.75 in the target (one seed with 4 episodes). "
    )
    assert "95" not in sentence(verdict) and "±" not in "".join(fact.value for fact in verdict.facts)
    assert any("With one seed, there is no interval" in remark for remark in verdict.remarks)


def test_ties_and_failures_are_told(results: Results) -> None:
    tied = verdict_of(with_success(results, astra=[1.0, 0.75, 1.0]))
    assert tied.row == "astra" and "Equal by the mean: ASTRA+." in tied.remarks
    row = results.methods["astra_plus"].model_copy(update={"failed": [0.75, 0.25, 0.5]})
    failing = results.model_copy(update={"methods": results.methods | {"astra_plus": summarized(row, 100)}})
    assert verdict_of(failing).remarks[-1].startswith("ASTRA+ fails in 50\N{NO-BREAK SPACE}% of its episodes")


def test_a_training_that_did_not_learn_its_simulator_is_told(tmp_path: Path, results: Results) -> None:
    told = "In the simulator of its training, it succeeds in 49\N{NO-BREAK SPACE}% of the episodes"

    def remarks(found: Results, own: list[float]) -> str:
        rows = {
            name: row.model_copy(update={"simulated_success": own}) for name, row in found.methods.items()
        }
        return " ".join(verdict_of(found.model_copy(update={"methods": rows})).remarks)

    assert told in remarks(results, [0.47, 0.0, 1.0])
    assert "In the simulator of its training" not in remarks(results, [0.5, 0.0, 1.0])
    # Of a chosen policy, it is what that one reaches.
    chosen = made(tmp_path, select=True)
    assert chosen.choice
    own = [0.49 if seed == chosen.choice.candidates[0].seed else 1.0 for seed in SEEDS]
    assert told in remarks(chosen, own)
    assert "In the simulator of its training" not in remarks(chosen, [1.49 - value for value in own])


def test_a_chosen_policy_that_is_not_tested_yet_is_deployed_all_the_same(tmp_path: Path) -> None:
    found = made(tmp_path, select=True)
    assert found.choice
    best = found.choice.candidates[0]
    row = found.methods[best.row]
    others = [seed for seed in row.seeds if seed != best.seed]
    tested = row.model_copy(update={"seeds": others, "simulated_success": [0.0] * len(others)})
    verdict = verdict_of(found.model_copy(update={"methods": found.methods | {best.row: tested}}))
    assert verdict.row == best.row
    assert "In the simulator of its training" not in " ".join(verdict.remarks)


def test_references_alone_are_not_deployed(results: Results) -> None:
    alone = {name: results.methods[name] for name in ("direct_transfer", "follower")}
    verdict = verdict_of(results.model_copy(update={"methods": alone}))
    assert verdict.row is None and sentence(verdict).startswith("No row to deploy: all rows are references.")


@pytest.mark.parametrize(
    ("settings", "percent", "text"),
    [
        ({"collect": {"episodes": 60}}, None, ", trained on 60 episodes of data for each of 3 seeds; "),
        (
            {"collect": {"episodes": 400, "least_steps": 80_000}},
            None,
            ", trained on 80,000 steps of data for each of 3 seeds; ",
        ),
        ({"collect": {"episodes": 60}}, 25, ", trained on 25 % of 60 episodes of data for each of 3 seeds; "),
        ({"data": "walks@data-1.0.0"}, None, ", trained on the episodes of walks@data-1.0.0; "),
        ({}, 25, "best mean over seeds; "),
    ],
)
def test_it_says_on_how_much_data(
    results: Results, settings: dict[str, object], percent: int | None, text: str
) -> None:
    assert text in sentence(verdict_of(results.model_copy(update={"settings": settings}), percent))


@pytest.mark.parametrize(
    ("name", "measure"), [("cart_study", "success"), ("humanoid_walker2d", "steps"), ("nao_kick", "success")]
)
def test_published_rows_are_judged_by_their_means(name: str, measure: str) -> None:
    path = PUBLISHED / f"{name}.json"
    rows = json.loads(path.read_text())["methods"]
    means = {key: sum(row[measure]) / len(row[measure]) for key, row in rows.items() if not row["role"]}
    found = read_published(path)
    assert isinstance(found, Results)
    assert verdict_of(found).row == max(means, key=means.__getitem__)


def test_a_published_choice_is_the_first_candidate() -> None:
    path = PUBLISHED / "antmaze_long_fresh.json"
    first = json.loads(path.read_text())["choice"]["candidates"][0]
    found = read_published(path)
    assert isinstance(found, Results)
    verdict = verdict_of(found)
    assert verdict.row == first["row"] and verdict.title.endswith(f", seed {first['seed']}")
    for share in (first["predicted"], first["target"]):
        assert f"{share:.2f}" in verdict.reason
    assert first["judges"] >= 3 and "withheld" not in verdict.reason
    for end in (first["low"], first["high"]):
        assert f"{end:.2f}" in verdict.reason
    # Two judges would be too few for an interval.
    assert found.choice is not None
    unsure = found.choice.candidates[0].model_copy(update={"judges": 2, "low": None, "high": None})
    choice = found.choice.model_copy(update={"candidates": [unsure, *found.choice.candidates[1:]]})
    reason = verdict_of(found.model_copy(update={"choice": choice})).reason
    assert "interval withheld" in reason


def test_a_choice_below_the_floor_does_not_overlap_with_it(results: Results) -> None:
    candidates = [candidate("astra", 0, 0.9)]
    choice = Choice(judge="nas", episodes=4, shares_episodes=False, candidates=candidates)
    apart = with_success(results, astra=[0.25, 0.25, 0.25], direct_transfer=[1.0, 1.0, 1.0])
    found = verdict_of(apart.model_copy(update={"choice": choice}))
    assert not any("overlap" in remark for remark in found.remarks)


def test_intervals_are_those_of_the_interquartile_mean(results: Results) -> None:
    row = results.methods["astra_plus"]
    summary = row.summary | {"success": Summary(0.9, 0.1, 0.95, 0.85, 0.98)}
    rows = results.methods | {"astra_plus": row.model_copy(update={"summary": summary})}
    verdict = verdict_of(results.model_copy(update={"methods": rows}))
    assert "; interquartile mean 0.95, 95 % interval 0.85 to 0.98)" in sentence(verdict)
    assert verdict.facts[0].note == "success, 3 seeds; IQM 0.95 [0.85, 0.98]"


def test_the_facts_of_a_choice_have_intervals_of_their_own(tmp_path: Path) -> None:
    predicted, measured, *_ = verdict_of(made(tmp_path, select=True)).facts
    assert predicted.note.replace("\N{NO-BREAK SPACE}", " ") == "95 % [1.00, 1.00], by 3 judges"
    # Wilson's interval of 3 of 4 episodes.
    assert measured.note.replace("\N{NO-BREAK SPACE}", " ") == "95 % [0.30, 0.95], 4 episodes of this policy"


@pytest.mark.parametrize(("ours", "its", "few"), [(3, 5, [3]), (5, 3, [3]), (4, 5, [])])
def test_the_row_with_fewer_seeds_decides_whether_there_are_enough(
    results: Results, ours: int, its: int, few: list[int]
) -> None:
    seeds = {"astra_plus": (ours, 1.0), "direct_transfer": (its, 0.0)}
    rows = {
        name: summarized(
            results.methods[name].model_copy(update={"seeds": [*range(count)], "success": [share] * count}),
            100,
        )
        for name, (count, share) in seeds.items()
    }
    remarks = verdict_of(results.model_copy(update={"methods": results.methods | rows})).remarks
    chance = "seeds: equal rows may differ as much by chance."
    assert remarks == [f"ASTRA+ and Direct transfer are compared over only {count} {chance}" for count in few]


def test_a_reference_is_no_tie(results: Results) -> None:
    # As many as the follower, which is the ceiling.
    verdict = verdict_of(with_success(results, astra_plus=[1.0, 1.0, 1.0]))
    assert verdict.row == "astra_plus" and not any("Equal by" in remark for remark in verdict.remarks)
