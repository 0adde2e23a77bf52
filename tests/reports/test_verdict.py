import re
from collections.abc import Collection, Mapping
from pathlib import Path

import fake_runs
import pytest
from fake_runs import line
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.cli.recipes import show_made
from astra_data.reports.choice import Candidate, Judgment, Trials
from astra_data.reports.results import SIMULATED, TESTED, Errors, Results, results_json
from astra_data.reports.verdict import Verdict, verdict_of
from astra_data.worlds.objective import SURVIVED_STEPS

Scores = Mapping[str, tuple[float, ...]]


def results(
    target: Scores,
    simulated: Scores | None = None,
    r2: dict[str, float] | None = None,
    *,
    failing: float = 0.5,
    **facts: object,
) -> Results:
    """Of episodes without success, the share `failing` are failures."""
    lines = [
        line(row, seed, where, success=one, steps=100 * one, failed=failing * (1 - one))
        for where, of in ((TESTED, target), (SIMULATED, simulated or {}))
        for row, scores in of.items()
        for seed, one in enumerate(scores)
    ]
    lines += [line(row, 0, "ground", r2_reward=value) for row, value in (r2 or {}).items()]
    return fake_runs.results(*lines, **{"rows": tuple(target), "episodes": 120} | facts)


FLOOR = {"direct_transfer": (0.2, 0.1, 0.2)}
GOOD = (0.9, 0.95, 1.0)


def words(verdict: Verdict) -> str:
    return " ".join([verdict.text, *verdict.remarks])


def test_the_best_method_is_deployed_with_its_best_seed() -> None:
    found = verdict_of(results(FLOOR | {"nas": (0.6, 0.7, 0.6), "astra": GOOD}, {"astra": (1.0, 1.0, 1.0)}))
    assert (found.row, found.seed) == ("astra", 2)
    labels = dict(found.lines)
    assert labels.keys() == {"best", "floor", "interval"}
    assert re.search(r"ASTRA: success 0.95 \[0\.\d\d, 1.00\] in the target", labels["best"])
    assert "Direct transfer" in labels["floor"] and "0.17" in labels["floor"]
    assert re.search(r"0.78 \[0\.\d\d, 0\.\d\d\]", labels["interval"])
    assert "Deploy" in found.text and "none" not in found.text


def test_a_lucky_seed_or_two_are_not_compared_with_three() -> None:
    assert verdict_of(results(FLOOR | {"nas": GOOD, "compass": (1.0, 1.0)})).row == "nas"
    assert verdict_of(results(FLOOR | {"nas": GOOD[:2], "compass": (1.0,)})).row == "nas"
    assert verdict_of(results(FLOOR | {"nas": (*GOOD, 0.9), "compass": (1.0,) * 3})).row == "compass"


def test_methods_are_compared_on_the_seeds_that_both_have() -> None:
    lucky = [line("astra", seed, success=0.9) for seed in (0, 1, 2)]
    nas = dict(enumerate((0.95, 0.95, 0.95, 0.2, 0.2, 0.2)))  # seeds 3 to 5 are hard

    def among(*rows: str, seeds: Collection[int]) -> Verdict:
        lines = [*lucky, *(line(row, seed, success=nas[seed]) for row in rows for seed in seeds)]
        return verdict_of(fake_runs.results(*lines, episodes=120))

    found = among("nas", seeds=nas)
    assert found.row == "nas" and "NAS and ASTRA are compared on seeds 0, 1 and 2: 0.95 and 0.9." in found.remarks
    assert among("direct_transfer", seeds=nas).row == "direct_transfer"
    few, none = among("nas", seeds=(2, 3, 4)), among("direct_transfer", seeds=(3, 4, 5))
    assert "NAS and ASTRA are compared on seed 2: 0.95 and 0.9; run the missing ones, to share 3" in words(few)
    assert none.row == "astra" and "on other seeds: 0.9 and 0.2; run the" in words(none)
    assert "compared" not in words(among("nas", seeds=(0, 1, 2)))


def test_a_method_that_did_not_learn_its_own_simulator_is_the_reason_to_deploy_none() -> None:
    target = FLOOR | {"nas": (0.19,) * 3, "astra": (0.1,) * 3}
    simulated = {"nas": (0.9,) * 3, "astra": (0.03,) * 3}
    found = verdict_of(results(target, simulated, {"astra": -2.7}))
    assert found.row is None and found.command("runs/r") is None and "Deploy none yet" in found.text
    assert "ASTRA did not learn its own simulator (0.03)" in found.text
    assert "-2.70" in words(found) and "`episodes` of `[collect]`" in words(found)
    learned = verdict_of(results(target, simulated, {"astra": 0.95}))
    assert "-2.70" not in words(learned) and "`total_steps` of `[train]`" in words(learned)
    both = verdict_of(results(target, {"nas": (0.04,) * 3, "astra": (0.03,) * 3}))  # what is compared comes first
    assert "ASTRA did not learn its own simulator (0.03) and NAS did" in both.text


@pytest.mark.parametrize(("raw", "is_worse"), [(1.0, True), (2.0, True), (2.1, False)])
def test_what_is_lost_on_the_way_is_the_reason_where_all_learned_their_simulators(raw: float, is_worse: bool) -> None:
    errors = [
        Errors(
            row="astra",
            seed=0,
            simulator=simulator,
            quantity="x_m",
            horizons=[1, 10],
            mean=[0.1, mean],
            low=[0.1, mean],
            high=[0.1, mean],
        )
        for simulator, mean in (("raw", raw), ("grounded", 2.0))
    ]
    of = FLOOR | {"astra": (0.3,) * 3}
    found = verdict_of(results(of, {"astra": GOOD}, errors=errors))
    assert found.row is None and "ASTRA, has success 0.30" in found.text
    assert ("correction is no better than none in `x_m`" in words(found)) == is_worse


@pytest.mark.parametrize(
    ("floor", "astra", "row"),
    [
        (0.9, 0.9, "direct_transfer"),  # nothing is gained
        (0.95, 0.2, "direct_transfer"),
        (0.4, 0.3, None),
        (0.1, 0.49, None),
        (0.1, 0.5, "astra"),
    ],
)
def test_the_rule_at_its_edges(floor: float, astra: float, row: str | None) -> None:
    found = verdict_of(results({"direct_transfer": (floor,) * 3, "astra": (astra,) * 3}))
    assert found.row == row
    assert ("do not show a difference" in dict(found.lines)["interval"]) == (abs(floor - astra) < 0.2)


@pytest.mark.parametrize("best", ["astra", "direct_transfer"])
def test_what_fails_in_a_third_of_its_episodes_is_not_deployed_however_often_it_succeeds(best: str) -> None:
    target = {"direct_transfer": (0.5,) * 3, "astra": (0.55,) * 3} | {best: (0.64,) * 3}
    found = verdict_of(results(target, failing=0.95))
    assert found.row is None
    assert "Deploy none yet" in found.text and "fails in 34 % of its episodes" in found.text
    assert verdict_of(results(target | {best: (0.66,) * 3}, failing=0.95)).row == best
    assert verdict_of(results({"astra": (0.5,) * 3}, failing=2 / 3)).row is None  # a third


def test_references_alone_are_nothing_to_deploy() -> None:
    found = verdict_of(results({"direct_transfer": GOOD, "follower": GOOD}))
    assert found.row is None and "all of them are references" in found.text


def test_few_seeds_have_no_interval_and_it_says_so() -> None:
    found = verdict_of(results({"direct_transfer": (0.1, 0.1), "astra": (0.8, 0.9)}))
    assert "need 3 seeds, ASTRA has 2" in words(found)
    assert "too few seeds for an interval" in dict(found.lines)["interval"]
    assert "expected `direct_transfer`" in dict(verdict_of(results({"astra": GOOD})).lines)["interval"]


def test_a_score_without_limit_is_compared_with_the_floor_alone() -> None:
    of = {"direct_transfer": (0.1, 0.1, 0.2), "astra": (0.2, 0.3, 0.2)}
    found = verdict_of(results(of, scores=(SURVIVED_STEPS,)))
    assert found.row == "astra" and "survived steps 23" in found.text


def test_judges_choose_the_seed_and_without_a_target_the_method() -> None:
    of = {"nas": (0.6, 0.6, 0.6), "astra": (0.8, 0.9, 1.0)}
    shares = {("astra", 0): 0.7, ("astra", 1): 0.4, ("nas", 0): 0.9}
    candidates = [
        Candidate(row=row, seed=seed, success=dict.fromkeys((7, 8, 9), share)) for (row, seed), share in shares.items()
    ]
    judged = Judgment(judge="nas", episodes=50, candidates=candidates)
    found = verdict_of(results(of, judged=judged))
    assert (found.row, found.seed) == ("astra", 0)
    assert "choose NAS, seed 0, with a predicted success of 0.90" in words(found)
    found = verdict_of(results(of, judged=judged, tested_in="simulators"))
    assert (found.row, found.seed) == ("nas", 0) and "predicted success 0.90" in found.text
    for chosen, percent, seed in ((("astra", 1), None, 1), (("astra", 1), 20, 0), (("nas", 2), None, 0)):
        tried = Trials(trials=4, field=2, pseudo_trials=4, percent=percent, chosen=chosen)
        assert verdict_of(results(of, judged=judged, trials=tried)).seed == seed
    ends = {0.9: ("astra", "Deploy **ASTRA, seed 1**: success 0.90 ["), 0.2: (None, "Deploy none yet; best")}
    for rate, (row, text) in ends.items():
        tried = Trials(trials=4, field=2, pseudo_trials=4, chosen=("astra", 1), rate=(rate, 0.1, 1.0))
        found = verdict_of(results(of, judged=judged, trials=tried, tested_in="simulators"))
        assert (found.row, found.seed) == (row, 1 if row else 0) and found.text.startswith(text)
    floor = dict.fromkeys((7, 8, 9), 0.2)
    both = [candidates[2], Candidate(row="direct_transfer", seed=0, success=floor)]
    other = [one.model_copy(update={"percent": 20, "success": dict.fromkeys((7, 8, 9), 0.1)}) for one in both]
    sized = judged.model_copy(update={"candidates": [one.model_copy(update={"percent": 100}) for one in both] + other})
    found = verdict_of(results(of | {"direct_transfer": (0.6,)}, judged=sized, tested_in="simulators"))
    assert dict(found.lines)["best"] == "NAS: predicted success 0.90 (1 seed)"  # of the largest size alone
    assert "NAS less Direct transfer: 0.70" in dict(found.lines)["interval"] and "Not judged" in words(found)


@pytest.mark.parametrize(("percent", "sizes"), [(100, []), (100, [20, 100]), (20, [20])])
def test_the_command_is_one_that_the_command_line_takes(percent: int, sizes: list[int], tmp_path: Path) -> None:
    settings, commands = {"sweep": {"percent": sizes}, "align": {"inputs": ["observation.imu"]}}, list[str | None]()
    for row in ("nas", "astra"):  # which acts on these inputs
        base = results({row: GOOD}, settings=settings)
        lines = [line.model_copy(update={"percent": percent}) for line in base.lines]
        commands.append(verdict_of(base.model_copy(update={"lines": lines})).command(tmp_path / "cart"))
    command, python = commands
    size, run = (percent if sizes else None), str(tmp_path / "cart")
    assert python == f"astra_data.load_policy({run!r}, 'astra', seed=2, percent={size})"
    assert command is not None and (f"--percent {percent} " in command) == bool(sizes)
    done = CliRunner().invoke(app, command.split()[1:])
    assert done.exit_code == 1 and "No such option" not in done.output  # it is understood; there is no such run


@pytest.mark.parametrize("success", [0.9, 0.1])
def test_a_run_ends_with_its_verdict_the_page_and_the_command_that_deploys(
    tmp_path: Path, success: float, capsys: pytest.CaptureFixture[str]
) -> None:
    of = {"astra": (success,) * 3, "direct_transfer": (0.05,) * 3}
    found = results(of, of)
    run = tmp_path / "a run"
    (run / "report").mkdir(parents=True)
    (run / "report/results.json").write_text(results_json(found))
    (page := run / "report/results.html").touch()
    show_made(run, None)
    first, verdict, best, floor, interval, *others = capsys.readouterr().out.splitlines()
    assert first == f"finished: {run}" and re.match(rf"  best +ASTRA: success {success:.2f} \[", best)
    assert re.match(r"  floor +Direct transfer .*: success 0.05 \[", floor)
    assert re.match(rf"  interval +ASTRA less Direct transfer: {success - 0.05:.2f} \[", interval)
    assert all("select" not in line for line in (verdict, *others))
    if success > 0.5:
        assert verdict.startswith("Deploy ASTRA: ")
        assert others == [str(page), f"astra-data deploy '{run}' --row astra --seed 0 --out 'a run_astra'"]
    else:
        assert verdict == "Deploy none yet: ASTRA did not learn its own simulator (0.10)."
        assert "`total_steps` of `[train]`" in others[0] and others[-1] == str(page)
