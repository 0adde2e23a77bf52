import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_report import CONFIG, FIGURES, LASTING_FIGURES, images, make, task
from fake_runs import (
    MADE,
    ROWS,
    FakeRecipe,
    edit_json,
    outcomes,
    write_elsewhere,
)

from astra_data.core.errors import BadInputError, MissingStageError
from astra_data.reports import assembly
from astra_data.reports.page import render
from astra_data.reports.schema import Results
from astra_data.stages import report as stage
from astra_data.stages.report import report
from astra_data.worlds.score import RETURN, SURVIVED_STEPS


def test_the_papers_figures_stand_beside_ours(root: Path, folder: Path) -> None:
    assert "the paper's" not in (folder / "results.md").read_text()
    config = CONFIG.model_copy(update={"paper_success": {"astra": 0.4}})
    report(FakeRecipe(), root=root, command="", publish=None, progress=lambda *_: None, config=config)
    page = (root / "report/results.md").read_text()
    assert "| method | seeds | success | the paper's | IQM [95 %] |" in page
    assert "| ASTRA | 3 | 0.50 ± 0.25 | 0.40 | " in page
    assert "their heights cannot" in page


def test_each_origin_is_shown_with_its_stages(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assembly, "origin", lambda: MADE)
    make(root)
    assert "- Code: commit `abc` with uncommitted changes.\n" in (root / "report/results.md").read_text()
    edit_json(root / "evaluate/astra/seed_1/evaluation.json", git_commit="def")
    edit_json(root / "pair/seed_0/meta/astra/dataset.json", git_commit=None)
    make(root)
    assert (
        "- Code: commit `abc` with uncommitted changes (collect, pair, ground, train, evaluate, report); "
        "not recorded (pair); commit `def` (evaluate).\n"
    ) in (root / "report/results.md").read_text()


def test_cost_gives_the_speed_of_every_stage(folder: Path) -> None:
    page = (folder / "results.md").read_text()
    assert "| collect | 15 s | - | 4 k target steps/s |" in page
    assert "| ground | 21 s | 42 s | 100 windows/s |" in page
    assert "| train | - | - | 96 k simulator steps/s; 48 k training steps/s |" in page
    assert "| evaluate | 2 min | 4 min | 1 k target steps/s |" in page
    assert "| whole recipe | 3 min | 5 min |  |" in page
    assert "| pair |" not in page  # neither time nor speed recorded


def test_cost_gives_what_one_seed_of_every_row_takes(folder: Path) -> None:
    page = (folder / "results.md").read_text()
    assert "| method | ground | train | align | evaluate | wall time | CPU time |" in page
    for row in ("ASTRA", "ASTRA+"):
        assert f"| {row} | 7 s | - | - | 10 s | 17 s | 34 s |" in page
    assert "| Careful follower | - | - | - | 10 s | 10 s | 20 s |" in page


def test_page_tells_how_well_the_simulators_foretell_the_target(folder: Path) -> None:
    page = (folder / "results.md").read_text()
    assert "| simulator | policies | Pearson [95 %] | Spearman [95 %] |" in page
    assert "| raw | 12 | 0.96 [" in page
    assert "| grounded | 9 | -1.00 [-1.00, -1.00] | -1.00 [-1.00, -1.00] |" in page
    assert "The grounding is each row's own." in page
    assert "Without" not in page


def test_rows_that_were_not_tested_in_simulators_are_named(root: Path) -> None:
    edit_json(root / "evaluate/follower/seed_1/evaluation.json", raw=None)
    make(root)
    assert " Without Careful follower: not tested there" in (root / "report/results.md").read_text()
    for row in ROWS:
        edit_json(root / f"evaluate/{row}/seed_1/evaluation.json", raw=None, grounded=None)
    make(root)
    assert "Predictive validity" not in (root / "report/results.md").read_text()
    assert not (root / "report/validity.png").exists()


def test_who_was_trained_in_the_target_is_set_apart(root: Path) -> None:
    write_elsewhere(root, "target", like="astra_plus")
    make(root, recipe=FakeRecipe(methods=("astra", "target", "follower")))
    page = (root / "report/results.md").read_text()
    assert "| ASTRA | 3 | **0.50 ± 0.25** |" in page
    assert "| Target (trained there) | 3 | 0.92 ± 0.14 |" in page
    assert "learned in the target itself" in page
    assert "| ASTRA | Target |" not in page


def test_the_table_says_how_many_seeds_each_row_has(root: Path) -> None:
    (root / "evaluate/astra_plus/seed_0/evaluation.json").unlink()
    make(root)
    page = (root / "report/results.md").read_text()
    assert "seeds 0, 1, 2 (rows have as many of them as the table says), 4 episodes per row" in page
    assert "| ASTRA+ | 2 | **0.88 ± 0.18** |" in page
    assert "| ASTRA | 3 | 0.50 ± 0.25 |" in page


def test_the_page_tells_of_longer_legs(root: Path) -> None:
    for file in (root / "evaluate").glob("*/*/evaluation.json"):
        edit_json(file, leg_scale=1.25)
    make(root)
    page = (root / "report/results.md").read_text()
    assert "4 episodes per row and seed. The target's legs are 1.25 times as long." in page
    edit_json(file, leg_scale=1.0)
    with pytest.raises(BadInputError, match=r"with legs 1"):
        make(root)


def test_the_page_says_that_a_robot_is_a_stand_in(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(root)
    assert "stand-in" not in (root / "report/results.md").read_text()
    monkeypatch.setattr(stage, "TASKS", {"antmaze-u": task(facts={"stand_in": "mujoco"})})
    make(root)
    assert (
        "**A simulated stand-in (`mujoco`) takes the physical robot's place"
        in (root / "report/results.md").read_text()
    )


def test_the_page_says_which_rows_are_not_finished(root: Path) -> None:
    for seed in (0, 1, 2):
        (root / f"evaluate/astra/seed_{seed}/evaluation.json").unlink()
    make(root)
    page = (root / "report/results.md").read_text()
    assert "Not finished yet: ASTRA." in page and "| ASTRA |" not in page
    shutil.rmtree(root / "evaluate")
    shutil.rmtree(root / "report")
    with pytest.raises(MissingStageError, match="found none for direct_transfer seed 0, 1, 2; astra seed"):
        make(root)
    assert not (root / "report").exists()


def test_page_holds_the_table_and_only_figures_that_exist(folder: Path) -> None:
    page = (folder / "results.md").read_text()
    assert "| Direct transfer (floor) | 3 | 0.17 ± 0.14 |" in page
    assert "| ASTRA+ | 3 | **0.92 ± 0.14** |" in page
    assert "| Careful follower (ceiling) | 3 | 1.00 ± 0.00 | 1.00 [1.00, 1.00] |" in page
    assert "| No grounding | 1 [0.5, 2] | 2 [1, nan] |" in page
    assert "astra-data run recipes/antmaze_u.toml" in page
    assert "[plus]" in page
    assert images(folder) == FIGURES
    assert {name for name in FIGURES if f"]({name}.png)" in page} == FIGURES


@pytest.mark.parametrize(
    ("changes", "missing"),
    [({"plane": None}, {"trajectories", "mismatch"}), ({"ball_index": 4}, {"mismatch"})],
)
def test_without_a_maze_or_with_a_ball_some_figures_make_no_sense(
    root: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, object], missing: set[str]
) -> None:
    monkeypatch.setattr(stage, "TASKS", {"antmaze-u": task(**changes)})
    make(root)
    assert images(root / "report") == FIGURES - missing


def test_of_lasting_tasks_the_page_tells_survived_steps_and_return(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lasting = task(plane=None, objective=SimpleNamespace(scores=(SURVIVED_STEPS, RETURN)))
    monkeypatch.setattr(stage, "TASKS", {"antmaze-u": lasting})
    points = [
        {"steps": steps, "success": None, "episode_steps": lasted}
        for steps, lasted in ((1000, 30.0), (2000, None), (3000, 90.0))
    ]
    for seed, steps in enumerate((60.0, 90.0, 600.0)):
        means = {"steps": 40.0 + 10 * seed, "return": 200.0 + seed}
        edit_json(
            root / f"evaluate/astra/seed_{seed}/evaluation.json",
            target=outcomes([0, 0, 0, 1], seed) | {"steps": [steps] * 4},
            encoders={"source": means, "target": means},
        )
        edit_json(root / f"evaluate/astra_plus/seed_{seed}/evaluation.json", encoders={})
        edit_json(root / f"train/astra/seed_{seed}/curve.json", points=points)
    make(root, note="best: ASTRA  survived steps 250")
    page = (root / "report/results.md").read_text()
    scores = "survived steps | IQM [95 %] | return | IQM [95 %]"
    assert f"| method | seeds | {scores} | failed | survived steps in its simulator |" in page
    assert "| ASTRA | 3 | **250 ± 303** | " in page
    assert "| **1.0 ± 1.0** | 1.0 [0.0, 2.0] | 0.75 ± 0.00 | 115 ± 0 |" in page
    assert "has a higher number of survived steps than" in page
    # Direct transfer lasts 115 steps with every seed.
    assert "| ASTRA | Direct transfer | 0.33 [" in page
    assert "| method | encoder | survived steps | return |" in page
    assert "| ASTRA | source | 50 ± 10 | 201.0 ± 1.0 |" in page
    assert "success" not in page
    drawn = images(root / "report")
    assert drawn == FIGURES - {"success", "trajectories", "mismatch", "learning"} | LASTING_FIGURES
    stored = (root / "report/results.json").read_text()
    curve = {"steps": [1000.0, 2000.0, 3000.0], "score": [30.0, None, 90.0]}
    assert json.loads(stored)["methods"]["astra"]["learning"] == [curve] * 3
    # What is stored tells the scores by itself.
    found = Results.model_validate_json(stored)
    assert found.scores == (SURVIVED_STEPS, RETURN)
    assert render(found, {name: f"{name}.png" for name in drawn}) == page
