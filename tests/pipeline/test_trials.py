import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from fake_runs import edit_json
from rail_run import ROOT, rail_run
from small_cart import LOGS_ALONE
from typer.testing import CliRunner

from astra_data import Column
from astra_data.cli.app import app
from astra_data.core.artifact import read_manifest
from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.grounding.files import load_grounding
from astra_data.pipeline import selecting as module
from astra_data.pipeline.recipe import recorded_settings
from astra_data.pipeline.selecting import Sheet, choose_by_trials, select
from astra_data.pipeline.trained_policy import TrainedPolicy, trained_policy
from astra_data.policies.running_policy import RunningPolicy
from astra_data.reports.choice import Trials, halve, standings

pytestmark = pytest.mark.usefixtures("quick_fits")
TASK = replace(LOGS_ALONE, goal=Column("goal", size=1, names=("goal_x",), astra={"unit": ["m"]}))
POLICIES = [("nas", 3), ("astra", 0)]
HEADER = "round,trial,policy,start_x,goal_x_m,result\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = rail_run(tmp_path_factory, seeds=[0, 1], methods=["direct_transfer", "nas", "astra"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("astra_data.pipeline.stages.select.judged_success", lambda *given: (given[-1] % 97) / 97)
        select(folder)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "rail"))


class Tries:
    """In place of `in_target`: who was tried how often from which seed; succeeds as it is asked."""

    def __init__(self, *, breaks_at: int = 0, success: float = 1.0) -> None:
        self.made: list[tuple[RunningPolicy, int, int, dict[str, Any]]] = []
        self.breaks_at, self.success = breaks_at, success

    def __call__(self, task: object, begin: Any, episodes: int, seed: int, **more: Any) -> Any:
        if len(self.made) + 1 == self.breaks_at:
            raise KeyboardInterrupt
        self.made.append((begin.args[0], episodes, seed, more))
        return SimpleNamespace(success=[self.success] * episodes)


@pytest.fixture
def tries(monkeypatch: pytest.MonkeyPatch) -> Tries:
    made = Tries()
    monkeypatch.setattr(module, "in_target", made)
    return made


def test_trials_are_made_in_the_target(folder: Path) -> None:
    (folder / "select/notes.txt").write_text("battery")
    place = (folder / "select").stat().st_ino  # where a shell may be, too
    shown = CliRunner().invoke(app, ["select", str(folder), "--trials", "12"])
    assert shown.exit_code == 0, shown.output
    assert (folder / "select/notes.txt").read_text() == "battery" and (folder / "select").stat().st_ino == place
    record = Trials.model_validate_json((folder / "select/trials.json").read_text())
    assert record.field == 4 and record.spent == 12 and record.percent is None
    assert [(of.trials, len(of.tried)) for of in record.rounds] == [(2, 4), (2, 2)]
    assert record.chosen is not None and record.chosen in record.rounds[-1].candidates
    row, seed = record.chosen
    assert record.rate and f"chosen with 12 trials: {row}, seed {seed}: success {record.rate[0]:.2f} [" in shown.output
    assert "## Trials in the target" in (folder / "select/select.md").read_text()
    manifest = read_manifest(folder / "select")
    assert manifest is not None and "trials.json" not in manifest.files  # as it grows
    assert manifest.faults(folder / "select", verify=True) == []


def test_the_best_predicted_are_tried_and_the_posterior_decides(folder: Path, tries: Tries) -> None:
    ranked = select(folder).ranked()
    found = choose_by_trials(folder, 40, field=4)
    assert found.rounds[0].candidates == [(one.row, one.seed) for one in ranked[:4]]
    chosen, mean = halve([one.lower for one in ranked], 40, lambda _, those, each: [each] * len(those), field=4)
    first = ranked[chosen]
    assert found.chosen == (first.row, first.seed) and found.mean == pytest.approx(mean)
    assert select(folder) == select(folder)  # the ranking stays, and so do the trials
    assert (folder / "select/trials.json").is_file()


def test_what_was_predicted_is_the_lower_quartile_over_the_judges(
    folder: Path, tries: Tries, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged = select(folder)
    split = [one.model_copy(update={"success": {8: 0.0, 9: 1.0}}) for one in judged.candidates]
    monkeypatch.setattr(module, "select", lambda *_, **__: judged.model_copy(update={"candidates": split}))
    found = choose_by_trials(folder, 4, field=2)
    # Of two successes in two trials, with a prediction of 0.25 that counts as four.
    assert found.mean == pytest.approx((4 * 0.25 + 2) / (4 + 2))


def test_candidates_of_a_round_meet_the_same_starts_and_goals(
    folder: Path, tries: Tries, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Mock(wraps=recorded_settings)
    monkeypatch.setattr("astra_data.pipeline.trained_policy.recorded_settings", read)
    choose_by_trials(folder, 20, field=4)
    assert read.call_count == 1 + 1 + len(tries.made)  # by it, by the choice, and for each that is tried
    seeds = [seed for *_, seed, _ in tries.made]
    assert [made[1] for made in tries.made] == [2] * 4 + [6] * 2
    assert len(set(seeds[:4])) == len(set(seeds[4:])) == 1 and seeds[0] != seeds[4]
    assert not set(seeds) & {derive(seed, "evaluation") for seed in range(9)}


@pytest.mark.parametrize("encoder", ["target", "source"])
def test_policies_are_deployed_as_they_are_evaluated(folder: Path, tries: Tries, encoder: str) -> None:
    edit_json(folder / "recipe.json", evaluate={"encoder": encoder, "leg_scale": 1.25})
    choose_by_trials(folder, 8, rows=["astra"], episodes=3)
    assert [made[0].target_encoder is not None for made in tries.made] == [encoder == "target"] * 2
    assert all(made[3]["leg_scale"] == 1.25 for made in tries.made)


def test_an_interruption_costs_one_candidate_at_most(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = Path(shutil.copytree(folder, tmp_path / "other"))
    whole = choose_by_trials(other, 20, field=4)
    broken = Tries(breaks_at=4)
    with monkeypatch.context() as patch:
        patch.setattr(module, "in_target", broken)
        with pytest.raises(KeyboardInterrupt):
            choose_by_trials(folder, 20, field=4)
        found = Trials.model_validate_json((folder / "select/trials.json").read_text())
        assert found.spent == 6 and found.chosen is None
        assert "Not finished" in (folder / "select/select.md").read_text()
        broken.breaks_at = 0
        choose_by_trials(folder, 20, field=4)
        assert len(broken.made) == 3 + 3  # one of the first round and both of the second were left
        choose_by_trials(folder, 20, field=4)
        assert len(broken.made) == 6
    shutil.rmtree(folder / "select")
    shutil.copytree(other / "select", folder / "select")
    assert choose_by_trials(folder, 20, field=4) == whole


def test_what_trials_cannot_be_made_of_is_refused(folder: Path, tries: Tries) -> None:
    with pytest.raises(BadInputError, match=r"--trials of 4 or more, for a first round of 2 .* got 3: give"):
        choose_by_trials(folder, 3)
    with pytest.raises(BadInputError, match=r"--trials of 12 or more, for a first round of 4 .* got 11"):
        choose_by_trials(folder, 11, field=4)
    with pytest.raises(BadInputError, match=r"--field: expected 2 candidates or more, got 1"):
        choose_by_trials(folder, 30, field=1)
    with pytest.raises(BadInputError, match=r"of the 6 that were judged, got 7: give another --field"):
        choose_by_trials(folder, 300, field=7)
    with pytest.raises(BadInputError, match=r"expected --percent to be a size of the run \(none\), got 50"):
        choose_by_trials(folder, 30, percent=50)
    assert not tries.made
    choose_by_trials(folder, 12)
    others: list[tuple[dict[str, Any], str]] = [
        ({"trials": 13}, "trials = 13, found 12 made with 12"),
        ({"trials": 12, "field": 2}, "field = 2, found 12 made with 4"),
    ]
    for other, told in others:
        with pytest.raises(BadInputError, match=f"with {told}: use the same settings"):
            choose_by_trials(folder, **other)


def test_a_task_without_a_target_is_tried_nowhere(folder: Path) -> None:
    edit_json(folder / "recipe.json", task=f"{ROOT}/tests/small_cart.py:LOGS_ALONE")
    with pytest.raises(BadInputError, match=r"expected a task with a target, got .*LOGS_ALONE: leave out"):
        choose_by_trials(folder, 12)


Keys = Callable[[str], str]


@pytest.fixture
def predicted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Any, Any]]:
    made = list[tuple[str, Any, Any]]()

    def from_starts(recipe: object, config: object, one: Any, state: Any, goal: Any, *, root: Path) -> list[float]:
        made.append((f"{one.row}/seed_{one.seed}", state, goal))
        return [0.2 + 0.6 * (number % 2) for number in range(len(state))]

    monkeypatch.setattr(module, "predicted_from", from_starts)
    return made


def pressing(key: Callable[[str], str], shown: list[str], *, quits_at: int = 0) -> Keys:
    """Press for each trial what `key` says of it, and q at one of them."""

    def ask(what: str) -> str:
        shown.append(what)
        return "q" if len(shown) == quits_at else key(what)

    return ask


def by_half(what: str) -> str:
    return "s" if "astra" in what or "trial 1 " in what else "f"


def test_a_person_makes_the_trials_and_may_stop_at_any(
    folder: Path, tmp_path: Path, tries: Tries, predicted: list[Any]
) -> None:
    whole = Path(shutil.copytree(folder, tmp_path / "whole"))
    shown = list[str]()
    found = choose_by_trials(whole, 12, by_hand=pressing(by_half, shown))
    assert len(shown) == 12 and not tries.made and found.by_hand and found.spent == 12
    ranked = [f"{one.row}/seed_{one.seed}" for one in select(whole).ranked()]
    assert [policy for policy, *_ in predicted[:4]] == ranked[:4] and len(predicted) == 6
    # All of a round are predicted, and run, from the same starts to the same goals, and by what the sheet says.
    lines = (whole / "select/trials.csv").read_text().splitlines()
    goals = [float(line.split(",")[-2]) for line in lines[1:]]
    assert goals[:8] == pytest.approx(predicted[0][2][:, 0].repeat_interleave(4).tolist(), rel=1e-3)
    assert len({*goals[:8]}) == 2 and not {*goals[:8]} & {*goals[8:]}
    priors = [one.lower for one in select(whole).ranked()]
    chosen, mean = halve(priors, 12, lambda number, *_: [sum(one.success) for one in found.rounds[number].tried])
    assert found.chosen and f"{found.chosen[0]}/seed_{found.chosen[1]}" == ranked[chosen]
    assert found.mean == mean and found.rounds[0].tried[0].predicted == [0.2, 0.8]
    rate = standings(select(whole), None, found.rounds)[found.chosen].rate
    assert found.rate == (rate.value, rate.low, rate.high)
    assert "is ahead, with a success of" in shown[-1]
    assert "(control variate)" in (whole / "select/select.md").read_text()
    for quits_at in (1, 4, 6, 3):
        partly = choose_by_trials(folder, 12, by_hand=pressing(by_half, [], quits_at=quits_at))
        assert partly.chosen is None and "Not finished" in (folder / "select/select.md").read_text()
    assert partly.spent == 0 + 3 + 5 + 2
    assert choose_by_trials(folder, 12, by_hand=pressing(by_half, [])) == found
    assert (folder / "select/trials.csv").read_text() == (whole / "select/trials.csv").read_text()
    assert choose_by_trials(folder, 12, by_hand=pressing(by_half, shown)) == found and len(shown) == 12
    assert (folder / "select/trials.csv").is_file() and select(folder) == select(whole)


def test_trials_by_hand_are_filled_into_the_sheet(folder: Path, predicted: list[Any]) -> None:
    sheet = folder / "select/trials.csv"
    command = ["select", str(folder), "--trials", "4", "--by-hand", "--field", "2"]
    shown = CliRunner().invoke(app, command)  # without a terminal
    assert shown.exit_code == 0, shown.output
    assert "round 1, trial 1 of 4: run " in shown.output and "0 trials are made: fill in trials.csv" in shown.output
    refused = CliRunner().invoke(app, [*command[:-1], "3", "--row", "nas"])
    assert refused.exit_code == 1 and not (folder / "set_aside").exists()
    lines = sheet.read_text().splitlines()
    voids, done = [line + "void" for line in lines[1:3]], [line + "s" for line in lines[1:]]
    sheet.write_text("\n".join([lines[0], *voids, *done]))
    shown = CliRunner().invoke(app, command)
    assert "chosen with 4 trials: " in shown.output and ": success 1.00 [0.34, 1.00]" in shown.output
    assert len(predicted) == 2 and read_manifest(folder / "select").faults(folder / "select", verify=True) == []  # type: ignore[union-attr]
    filled = sheet.read_text()
    sheet.write_text("\n".join(lines))
    shown = CliRunner().invoke(app, command)
    assert "0 trials are made: fill in trials.csv" in shown.output and "chosen with" not in shown.output
    sheet.write_text(filled)
    assert "chosen with 4" in CliRunner().invoke(app, command).output
    with pytest.raises(BadInputError, match="by_hand = False, found 4 made with True: use the same settings"):
        choose_by_trials(folder, 4, field=2)
    edit_json(folder / "recipe.json", task=f"{ROOT}/tests/small_cart.py:LOGS_ALONE")
    sheet.unlink()
    with pytest.raises(BadInputError, match=r"trials.csv: expected the sheet of the trials, found .*No such file"):
        choose_by_trials(folder, 4, field=2, by_hand=str)


def test_results_that_a_later_round_was_not_planned_for_are_refused(folder: Path, predicted: list[Any]) -> None:
    choose_by_trials(folder, 12, by_hand=pressing(by_half, [], quits_at=10))
    sheet = folder / "select/trials.csv"
    before = sheet.read_text()
    turned = before.replace("success", "#").replace("failure", "success").replace("#", "failure")
    sheet.write_text(turned)
    with pytest.raises(BadInputError, match=r"trials.csv: expected the results that round 2 was planned for, found"):
        choose_by_trials(folder, 12, by_hand=by_half)
    sheet.write_text(before)
    assert choose_by_trials(folder, 12, by_hand=by_half).spent == 12


def test_keys_are_read_from_a_terminal(folder: Path, predicted: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    keys = iter("SfvsX")
    monkeypatch.setattr("astra_data.cli.recipes.sys", SimpleNamespace(stdin=SimpleNamespace(isatty=lambda: True)))
    monkeypatch.setattr("typer.getchar", lambda: next(keys, "q"))
    shown = CliRunner().invoke(app, ["select", str(folder), "--trials", "12", "--by-hand"])
    assert "3 trials are made: fill in trials.csv" in shown.output and "s: success, f: failure" in shown.output
    results = [line.rpartition(",")[2] for line in (folder / "select/trials.csv").read_text().splitlines()[1:]]
    assert results[:5] == ["success", "failure", "void", "success", ""]


def test_what_is_predicted_is_by_the_candidates_judges_from_the_starts(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[tuple[Any, ...]]()

    def judged_from(*given: Any) -> torch.Tensor:
        asked.append(given)
        return torch.tensor([0.25, 1.0])

    monkeypatch.setattr("astra_data.pipeline.stages.select.judged_from", judged_from)
    found = choose_by_trials(folder, 4, field=2, by_hand=lambda _: "q")
    assert found.rounds[0].predicted == [[0.25, 1.0]] * 2 and len(asked) == 2
    for (row, seed), (_, judge, policy, state, goal, drawn) in zip(found.rounds[0].candidates, asked, strict=True):
        assert (policy.source_encoder is None) == (row == "direct_transfer")
        assert state.shape == goal.shape == (2, 1) and drawn == derive(1 - seed, f"predicted: {seed}")
        other: Any = load_grounding(folder / f"ground/nas/seed_{1 - seed}/grounding.safetensors")
        weights = (next(one.encoder.encoder.parameters()) for one in (judge, other))
        assert torch.equal(*weights)


def test_trials_are_of_the_size_that_is_asked_for(folder: Path, tries: Tries, monkeypatch: pytest.MonkeyPatch) -> None:
    judged, made, loaded = select(folder), trained_policy, list[int | None]()
    sized = [one.model_copy(update={"percent": size}) for size in (50, 100) for one in judged.candidates]
    both = judged.model_copy(update={"candidates": sized})
    settings = recorded_settings(folder)

    def noted(run: Path, row: str, *, seed: int, percent: int | None = None) -> TrainedPolicy:
        loaded.append(percent)
        return made(run, row, seed=seed)

    monkeypatch.setattr(module, "trained_policy", noted)
    monkeypatch.setattr(module, "select", lambda *_, **__: both)
    monkeypatch.setattr(module, "settings_of", lambda _: settings | {"sweep": {"percent": [50, 100]}})
    with pytest.raises(BadInputError, match=r"a size of the run \(50, 100\), got none"):
        choose_by_trials(folder, 20, field=4)
    found = choose_by_trials(folder, 20, field=4, percent=50)
    assert found.percent == 50 and loaded == [50] * 6
    assert found.rounds[0].candidates == [(one.row, one.seed) for one in both.ranked(50)[:4]]
    by_hand = Mock(return_value=found)
    with monkeypatch.context() as patch:
        patch.setattr(module, "choose_by_trials", by_hand)
        CliRunner().invoke(app, ["select", str(folder), "--trials", "20", "--by-hand", "--percent", "50"])
    assert by_hand.call_args.kwargs["percent"] == 50
    with pytest.raises(BadInputError, match=r"with percent = 100, found 20 made with 50: use the same settings"):
        choose_by_trials(folder, 20, field=4, percent=100)
    monkeypatch.setattr(module, "settings_of", lambda _: settings)
    alone = judged.model_copy(update={"candidates": judged.candidates[:1]})
    monkeypatch.setattr(module, "select", lambda *_, **__: alone)
    with pytest.raises(BadInputError, match=r"two candidates or more to try, of the 1 that were judged"):
        choose_by_trials(folder, 20)


def sheet(folder: Path) -> Sheet:
    made = Sheet(folder / "trials.csv", TASK)
    made.plan(0, POLICIES, np.array([[-0.0], [0.25]]), np.array([[1.5], [1.23456]]))
    return made


def typing(keys: str, shown: list[str]) -> Callable[[str], str]:
    left = iter(keys)

    def ask(what: str) -> str:
        shown.append(what)
        return next(left)

    return ask


def test_each_start_is_run_by_every_policy_before_the_next(tmp_path: Path) -> None:
    made = sheet(tmp_path)
    made.plan(1, POLICIES[:1], np.array([[1.0]]), np.array([[2.0]]))
    made.write()
    lines = "1,1,nas/seed_3,0,1.5,\n1,2,astra/seed_0,0,1.5,\n1,3,nas/seed_3,0.25,1.235,\n1,4,astra/seed_0,0.25,1.235,\n"
    assert (tmp_path / "trials.csv").read_text() == f"{HEADER}{lines}2,1,nas/seed_3,1,2,\n"


def test_keys_fill_the_sheet_and_a_void_trial_is_repeated(tmp_path: Path) -> None:
    made, shown = sheet(tmp_path), list[str]()
    assert not made.fill(0, typing("sv?vfq", shown), lambda: f"{len(shown)} shown")
    assert shown[0] == "0 shown\nround 1, trial 1 of 4: run nas/seed_3 for 4 s, start_x 0, goal_x_m 1.5"
    assert shown[2].endswith("trial 2 of 4, again, as it was void: run astra/seed_0 for 4 s, start_x 0, goal_x_m 1.5")
    assert [text.split(" of ")[0][-1] for text in shown] == list("122223")
    text = (tmp_path / "trials.csv").read_text()
    voids = "1,2,astra/seed_0,0,1.5,void\n" * 2
    assert f"1,1,nas/seed_3,0,1.5,success\n{voids}1,2,astra/seed_0,0,1.5,failure\n1,3" in text
    again = sheet(tmp_path)
    again.read()
    again.write()
    assert (tmp_path / "trials.csv").read_text() == text and again.results == made.results
    assert again.counted(0, "nas", 3, [0.1, 0.2]) == ([1], [0.1])
    assert again.counted(0, "astra", 0, [0.3, 0.4]) == ([0], [0.3])
    assert again.fill(0, typing("sf", shown), str)
    assert again.counted(0, "astra", 0, [0.3, 0.4]) == ([0, 0], [0.3, 0.4])
    assert again.fill(0, typing("", shown), str)


def test_what_was_filled_in_meanwhile_is_kept(tmp_path: Path) -> None:
    made = sheet(tmp_path)
    made.write()
    path = tmp_path / "trials.csv"

    def ask(what: str) -> str:
        if "trial 1 " in what:
            path.write_text(path.read_text().replace("1,4,astra/seed_0,0.25,1.235,", "1,4,astra/seed_0,0.25,1.235,f"))
        return "s"

    assert made.fill(0, ask, str) and [*made.results.values()] == [["success"]] * 3 + [["failure"]]


def test_a_sheet_of_a_spreadsheet_is_understood(tmp_path: Path) -> None:
    made = sheet(tmp_path)
    lines = [
        '1,3,nas/seed_3,0.25000,1.2350,"Success "',
        ",,,,,",
        "1,1,nas/seed_3,0.0,1.50,S",
        "1,1,nas/seed_3,0,1.5,VOID",
    ]
    (tmp_path / "trials.csv").write_bytes(("\ufeff" + HEADER + "\n".join(lines)).replace("\n", "\r\n").encode())
    made.read()
    assert [*made.results.values()] == [["success", "void"], [], ["success"], []]
    made.write()
    rows = (tmp_path / "trials.csv").read_text().splitlines()
    assert [row.rpartition(",")[2] for row in rows[1:]] == ["void", "success", "", "success", ""]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1,1,nas/seed_3,0,1.5,perhaps", "line 2: expected success, failure, void or nothing as result, found perhaps"),
        ("1,1,nas/seed_3,0,1.5", "line 2: expected 6 cells, found 5"),
        ("1,5,nas/seed_3,0,1.5,s", "line 2: expected round, trial and policy as planned, found 1,5,nas/seed_3"),
        ("1,1,astra/seed_0,0,1.5,s", "line 2: expected round, trial and policy as planned, found 1,1,astra/seed_0"),
        ("1,1,nas/seed_3,0.5,1.5,s", "line 2: expected start_x 0, found 0.5"),
        ("1,1,nas/seed_3,0,,s", "line 2: expected goal_x_m 1.5, found nothing"),
        (
            "1,1,nas/seed_3,0,1.5,f\n1,1,nas/seed_3,0,1.5,s",
            "line 3: expected one result of trial 1 of round 1, found a",
        ),
    ],
)
def test_a_malformed_line_is_named_and_nothing_is_taken(tmp_path: Path, line: str, expected: str) -> None:
    made, path = sheet(tmp_path), tmp_path / "trials.csv"
    path.write_text(f"{HEADER}{line}\n1,2,astra/seed_0,0,1.5,s\n")
    before = path.read_bytes()
    with pytest.raises(BadInputError) as refused:
        made.read()
    assert f"{path}, {expected}" in str(refused.value) and "remove the line for a new one" in str(refused.value)
    assert not any(made.results.values()) and path.read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"round;trial\n", b"\xff\xfe\x00", b'round,"trial\n', b"a,b\n1,\x00\n"])
def test_what_is_no_sheet_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "trials.csv").write_bytes(content)
    with pytest.raises(BadInputError, match=r"trials.csv.*expected .*, found .*: "):
        sheet(tmp_path).read()
    (tmp_path / "trials.csv").unlink()
    with pytest.raises(BadInputError, match=r"expected the sheet of the trials, found .*No such file"):
        sheet(tmp_path).read()
