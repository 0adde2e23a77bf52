"""The report over small runs: what it writes where; its page is tested in tests/reports/test_page.py."""

import json
import shutil
from base64 import b64decode
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_dataset import write_fake
from fake_report import CONFIG, FIGURES, LASTING_FIGURES, REPLAY, images, make, task
from fake_runs import (
    MADE,
    ROWS,
    SEEDS,
    FakeRecipe,
    edit_json,
    outcomes,
    write_choice,
    write_elsewhere,
    write_evaluation,
    write_json,
    write_runs,
)
from html_pages import read_page
from matplotlib.figure import Figure

from astra_data.core.digest import file_digest
from astra_data.core.errors import BadInputError, MissingStageError
from astra_data.core.manifest import read_manifest
from astra_data.core.naming import seed_folder
from astra_data.reports.page import render
from astra_data.reports.schema import Results
from astra_data.reports.sizes import SizesResults
from astra_data.stages import report as stage
from astra_data.stages.report import report
from astra_data.worlds.registry import TASKS
from astra_data.worlds.score import RETURN, SURVIVED_STEPS


@pytest.fixture(scope="module")
def tasks() -> Iterator[None]:
    """Give the report a task of its own, and no target to replay commands in."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage, "task_named", {"antmaze-u": task()}.__getitem__)
        patch.setattr(stage, "replay_commands", lambda _: REPLAY)
        yield


@pytest.fixture
def root(tasks: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Runs whose report has rough figures, which are drawn quickly."""

    def rough(figure: Figure) -> bytes:
        figure.set_layout_engine("none")
        figure.savefig(content := BytesIO(), format="png", dpi=20)
        return content.getvalue()

    monkeypatch.setattr("astra_data.reports.figures.png", rough)
    return write_runs(tmp_path)


@pytest.fixture(scope="module")
def folder(tasks: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a finished report, for tests that only read it."""
    root = write_runs(tmp_path_factory.mktemp("report"))
    make(root)
    return root / "report"


@pytest.fixture
def values(folder: Path) -> Any:  # noqa: ANN401 - JSON
    return json.loads((folder / "results.json").read_text())


def test_json_uses_the_names_of_the_artifacts(values: Any) -> None:  # noqa: ANN401 - JSON
    row = values["methods"]["astra"]
    assert row["return"] == [0.0, 1.0, 2.0]
    assert set(row["summary"]) == {
        "success",
        "failed",
        "wall_contact",
        "steps",
        "return",
        "distance",
        "simulated_success",
        "simulated_steps",
    }
    assert set(row["summary"]["success"]) == {"mean", "std", "iqm", "low", "high"}
    learning = {"steps": [0.0, 1000.0, 2000.0], "score": [None, 0.5, 0.75]}
    assert row["learning"] == [learning] * 3


def test_the_manifest_names_the_evaluations(folder: Path) -> None:
    manifest = read_manifest(folder)
    assert manifest and manifest.faults(folder, verify=True) == manifest.foreign(folder) == []
    evaluations = {path.parent: path for path in folder.parent.glob("evaluate/*/*/evaluation.json")}
    digests = {str(key.relative_to(folder.parent)): file_digest(path) for key, path in evaluations.items()}
    assert evaluations and manifest.made_from == digests


@pytest.mark.parametrize("changed", [{"paper_success": {"astar": 0.4}}, {"compare": ("astar",)}])
def test_a_row_that_is_no_method_is_refused(root: Path, changed: dict[str, object]) -> None:
    config = CONFIG.model_copy(update=changed)
    with pytest.raises(BadInputError, match="astar"):
        report(FakeRecipe(), root=root, command="", publish=None, progress=lambda *_: None, config=config)


def test_the_methods_that_are_named_are_compared(root: Path) -> None:
    config = CONFIG.model_copy(update={"compare": ("direct_transfer",)})
    report(FakeRecipe(), root=root, command="", publish=None, progress=lambda *_: None, config=config)
    compared = json.loads((root / "report/results.json").read_text())["probability_of_improvement"]
    assert [*compared] == ["direct_transfer"]
    assert compared["direct_transfer"]["astra"]["difference"]["mean"] < 0


def test_origin_is_what_the_artifacts_recorded(values: Any, folder: Path) -> None:  # noqa: ANN401 - JSON
    assert values["command"] == "astra-data run recipes/antmaze_u.toml"
    made, drawn = values["origins"]
    assert made["stages"] == ["collect", "pair", "ground", "train", "evaluate"]
    assert made["commit"] == "abc-dirty"
    assert (made["machine"], made["packages"]) == (MADE["machine"], MADE["packages"])
    assert drawn["stages"] == ["report"]
    assert drawn["packages"]["numpy"] == np.__version__
    page = (folder / "results.md").read_text()
    assert "on Fast, 8 cores, 16 GiB of memory, H200. Total wall time" in page
    assert "- Code: commit `abc` with uncommitted changes (collect, pair, ground, train, evaluate); " in page
    assert "- Versions: torch 2.0.0 (collect, pair, ground, train, evaluate); python " in page
    first = {"name": "antmaze-u-random", "version": "data-1.0.0", "content_hash": "hash0"}
    assert values["datasets"][0] == first | {"stage": "collect", "seed": 0}
    trained, follower = values["evaluated_with"]
    assert trained["hashes"] == ["hash0", "hash1", "hash2"]
    assert follower == {"versions": [None] * 3, "hashes": [None] * 3, "methods": ["follower"]}


def test_code_of_ones_own_is_named_where_there_is_some(root: Path, folder: Path) -> None:
    assert "Own code" not in (folder / "results.md").read_text() + (folder / "results.html").read_text()
    assert "own_code" not in json.loads((folder / "results.json").read_text())
    digests = {"task": "0a", "astra": "1b", "astra.settings": "{}", "gone": "2c"}
    write_json(root / "code.json", digests)
    make(root)
    assert json.loads((root / "report/results.json").read_text())["own_code"] == {"task": "0a", "astra": "1b"}
    lines = (root / "report/results.md").read_text().splitlines()
    line = lines.index("- Own code: task `0a`, astra `1b`.")
    assert lines[line - 1].startswith("- Code: ") and lines[line + 1].startswith("- Machine: ")
    page = (root / "report/results.html").read_text()
    assert "<li>Own code: task <code>0a</code>, astra <code>1b</code>.</li>" in page


def test_a_row_that_was_in_no_simulator_is_reported(root: Path) -> None:
    write_elsewhere(root, "iql")
    make(root, recipe=FakeRecipe(methods=("iql", "follower")))
    page = (root / "report/results.md").read_text()
    assert "| IQL | 3 | **0.17 ± 0.14** |" in page
    assert "| IQL | - | 3 s | - | 10 s | 13 s | - |" in page
    assert not (root / "report/learning.png").exists()


def test_every_dataset_is_named_and_timed(root: Path) -> None:
    made = {"name": "antmaze-u-random", "version": "data-2.0.0", "content_hash": "hash"}
    for made_by, seconds in (("label", 11.0), ("augment", 13.0)):
        write_json(
            root / made_by / seed_folder(1, None) / "meta/astra/dataset.json",
            made | {"wall_seconds": seconds},
        )
    make(root)
    found = Results.model_validate_json((root / "report/results.json").read_text())
    stages = [(dataset.stage, dataset.seed) for dataset in found.datasets if dataset.version == "data-2.0.0"]
    assert stages == [("augment", 1), ("label", 1)]
    assert (found.wall_seconds["label"], found.wall_seconds["augment"]) == (11.0, 13.0)
    assert found.wall_seconds["total"] >= 24.0
    page = (root / "report/results.md").read_text()
    assert page.index("| collect |") < page.index("| label | 11 s |") < page.index("| augment | 13 s |")


def test_publishing_copies_all_under_the_recipes_name(root: Path, tmp_path: Path) -> None:
    published = tmp_path / "results"
    make(root, published)
    figures = {f"antmaze_u_{name}.png" for name in FIGURES}
    assert {path.name for path in published.iterdir()} == figures | {"antmaze_u.json", "antmaze_u.md"}
    assert "](antmaze_u_mismatch.png)" in (published / "antmaze_u.md").read_text()


def test_the_html_page_has_every_figure_of_the_folder_and_is_not_published(
    root: Path, tmp_path: Path
) -> None:
    make(root, tmp_path / "results")
    page = read_page((root / "report/results.html").read_text())
    inlined = [b64decode((image["src"] or "").partition("base64,")[2]) for image in page.attributes("img")]
    assert sorted(inlined) == sorted(path.read_bytes() for path in (root / "report").glob("*.png"))
    assert "Deploy ASTRA+: success 0.92 ± 0.14 in the target" in page.text
    manifest = read_manifest(root / "report")
    assert manifest and manifest.faults(root / "report", verify=True) == []
    assert manifest.foreign(root / "report") == []
    assert not list((tmp_path / "results").glob("*.html"))


def test_successes_are_counted_as_lerobot_counts_them(folder: Path) -> None:
    info = json.loads((folder / "eval_info.json").read_text())
    counted = info["per_group"]["astra"]
    assert (counted["n_episodes"], counted["n_success"], counted["pc_success"]) == (12, 6, 50.0)
    assert counted["pc_success_ci95"] == pytest.approx([25.38, 74.62], abs=0.01)
    assert {one["task_id"] for one in info["per_task"]} == {*SEEDS}


def test_the_html_page_tells_how_failures_are_foreseen(root: Path) -> None:
    for seed in SEEDS:
        found = {
            "failures": 3 + seed,
            "auc": {"1-20": 0.9, "11-30": 0.8, "21-40": None},
            "brier_skill": 0.25,
            "reliability": [(0.005, 0.0, 90), (0.4, 0.5, 10)],
        }
        edit_json(root / f"ground/astra/seed_{seed}/metrics.json", failures={"failure_model": found})
    make(root)
    page = read_page((root / "report/results.html").read_text())
    assert page.table("On held-out episodes")[1] == [
        *("ASTRA: failure model", "12", "0.90", "0.80", "-", "0.25", "0.50 of 0.40"),
    ]
    assert len(page.attributes("img")) == 1 + len(images(root / "report"))
    assert "Reliability of the failure model" in page.text


def test_results_are_added_to_published_ones(root: Path, tmp_path: Path) -> None:
    published = tmp_path / "results"
    make(root, published, FakeRecipe(seeds=(0, 1)))
    drawn = (published / "antmaze_u_trajectories.png").read_bytes()
    for row in ROWS:
        for seed in (0, 1):
            shutil.rmtree(root / f"evaluate/{row}/seed_{seed}")
    shutil.rmtree(root / "evaluate/astra_plus")
    make(root, published, add_to=published / "antmaze_u.json")
    page = (published / "antmaze_u.md").read_text()
    assert "| ASTRA | 3 | 0.50 ± 0.25 |" in page
    assert "| ASTRA+ | 2 | **0.88 ± 0.18** |" in page
    # The trajectories of ASTRA+ are not here: the figure stays as it is.
    assert "](antmaze_u_trajectories.png)" in page
    assert (published / "antmaze_u_trajectories.png").read_bytes() == drawn
    assert not (root / "report/trajectories.png").exists()
    assert "](trajectories.png)" not in (root / "report/results.md").read_text()


def test_published_rows_are_not_lost_unsaid(root: Path, tmp_path: Path) -> None:
    published = tmp_path / "results"
    make(root, published, FakeRecipe(seeds=(0, 1)))
    before = {path.name: path.read_bytes() for path in published.iterdir()}
    shutil.rmtree(root / "report")
    with pytest.raises(BadInputError, match=r"antmaze_u.json: .* of seed 1.*: use --add to keep them"):
        make(root, published, FakeRecipe(seeds=(0, 2)))
    assert {path.name: path.read_bytes() for path in published.iterdir()} == before
    assert not (root / "report").exists()


def test_there_must_be_results_to_add_to(root: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"expected published results in .*antmaze_u.json, found none"):
        make(root, add_to=tmp_path / "antmaze_u.json")
    (tmp_path / "antmaze_u.json").write_text("{}")
    with pytest.raises(BadInputError, match=r"antmaze_u.json does not hold results in the current format"):
        make(root, add_to=tmp_path / "antmaze_u.json")


def test_one_seed_of_rows_without_training_is_enough(root: Path) -> None:
    make(root, recipe=FakeRecipe(methods=("follower",), seeds=(1,)))
    values = json.loads((root / "report" / "results.json").read_text())
    alone = {"mean": 1.0, "std": None, "iqm": 1.0, "low": None, "high": None}
    assert values["methods"]["follower"]["summary"]["success"] == alone
    assert values["probability_of_improvement"] == {}
    assert (
        "| Careful follower (ceiling) | 1 | 1.00 | 1.00 | 0.00 |"
        in (root / "report" / "results.md").read_text()
    )


def test_sizes_are_set_side_by_side(tasks: None, tmp_path: Path) -> None:
    root = tmp_path / "runs" / "sizes"
    for percent in (50, 100):
        for seed in SEEDS:
            write_evaluation(root, "astra", seed, percent)
            write_evaluation(root, "direct_transfer", seed, percent)
            write_fake(root / "subset" / seed_folder(seed, percent))
    # At 50 % one seed of ASTRA is worse.
    path = root / "evaluate/astra" / seed_folder(2, 50) / "evaluation.json"
    edit_json(path, target=outcomes([0, 0, 0, 0], 2))
    sized = FakeRecipe("sizes", methods=("direct_transfer", "astra"), percents=(50, 100))
    make(root, tmp_path / "results", sized)
    found = SizesResults.model_validate_json((root / "report/results.json").read_text())
    success = {size.percent: size.results.methods["astra"].success for size in found.sizes}
    assert success == {50: [0.5, 0.25, 0.0], 100: [0.5, 0.25, 0.75]}
    assert [dataset.stage for dataset in found.sizes[0].results.datasets] == ["subset"] * 3
    page = (root / "report/results.md").read_text()
    assert "| method | 50 % | 100 % |" in page
    html = read_page((root / "report/results.html").read_text())
    head, _, astra = html.table("Success in the target, mean")
    assert (head, astra) == (["method", "50 %", "100 %"], ["ASTRA", "0.25 ± 0.25", "0.50 ± 0.25"])
    assert "| ASTRA | 0.25 ± 0.25 | 0.50 ± 0.25 |" in page
    assert (root / "report/data_efficiency.png").stat().st_size > 0
    published = (tmp_path / "results/sizes.md").read_text()
    assert "](sizes_data_efficiency.png)" in published
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == [
        "sizes.json",
        "sizes.md",
        "sizes_data_efficiency.png",
    ]


def test_a_report_of_sizes_leaves_open_what_is_not_finished(tasks: None, tmp_path: Path) -> None:
    root = tmp_path / "runs" / "sizes"
    sized = FakeRecipe("sizes", methods=("direct_transfer", "astra"), percents=(10, 150, 50, 100))
    with pytest.raises(MissingStageError, match="found none for direct_transfer seed 0, 1, 2; astra seed"):
        make(root, recipe=sized)
    for seed in SEEDS:
        write_evaluation(root, "astra", seed, 50)
        write_evaluation(root, "astra", seed, 100)
        write_evaluation(root, "direct_transfer", seed, 100)
    published = tmp_path / "results"
    make(root, published, sized)
    found = SizesResults.model_validate_json((root / "report/results.json").read_text())
    assert [(size.percent, list(size.results.methods)) for size in found.sizes] == [
        *((50, ["astra"]), (100, ["direct_transfer", "astra"])),
    ]
    html = read_page((root / "report/results.html").read_text())
    assert html.table("Success in the target, mean")[1:] == [
        ["Direct transfer", "-", "0.17 ± 0.14"],
        ["ASTRA", "0.50 ± 0.25", "0.50 ± 0.25"],
    ]
    unfinished = "Direct transfer at 50 %; all rows at 10 %; all rows at 150 %."
    assert f"Not finished yet: {unfinished}" in html.text
    # Other sizes are added to what is published.
    shutil.rmtree(root / "evaluate")
    for seed in SEEDS[:2]:
        write_evaluation(root, "direct_transfer", seed, 10)
    make(root, published, sized, add_to=published / "sizes.json")
    page = (published / "sizes.md").read_text()
    assert "| method | 10 % | 50 % | 100 % |" in page
    assert "| Direct transfer | 0.12 ± 0.18 (2 seeds) | - | 0.17 ± 0.14 |" in page


def test_rows_that_were_tested_in_no_simulator_have_no_predictive_validity(root: Path) -> None:
    for row in ROWS:
        edit_json(root / f"evaluate/{row}/seed_1/evaluation.json", raw=None, grounded=None)
    make(root)
    assert "Predictive validity" not in (root / "report/results.md").read_text()
    assert images(root / "report") == FIGURES - {"validity"}


def test_the_page_says_that_a_robot_is_a_stand_in(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "task_named", {"antmaze-u": task(facts={"stand_in": "mujoco"})}.__getitem__)
    make(root)
    text = "**A simulated stand-in (`mujoco`) replaces the physical robot"
    assert text in (root / "report/results.md").read_text()


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
    assert "| No grounding | 1 [0.5, 2] | 2 |" in page
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
    monkeypatch.setattr(stage, "task_named", {"antmaze-u": task(**changes)}.__getitem__)
    make(root)
    assert images(root / "report") == FIGURES - missing


def test_of_lasting_tasks_the_page_tells_survived_steps_and_return(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lasting = task(plane=None, objective=SimpleNamespace(scores=(SURVIVED_STEPS, RETURN)))
    monkeypatch.setattr(stage, "task_named", {"antmaze-u": lasting}.__getitem__)
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
    assert not (root / "report/eval_info.json").exists()
    assert render(found, {name: f"{name}.png" for name in drawn}) == page


def test_a_choice_without_the_target_is_reported(root: Path, tmp_path: Path) -> None:
    write_choice(root)
    make(root, tmp_path / "results")
    choice = json.loads((root / "report/results.json").read_text())["choice"]
    assert [(one["row"], one["seed"]) for one in choice["candidates"][:3]] == [
        ("astra", s) for s in (2, 0, 1)
    ]
    # ASTRA has 0.5, 0.25 and 0.75 in the target, its ranks are right; the best there is ASTRA+ with 1.
    assert choice["regret"] == pytest.approx(0.25)
    assert choice["calibration"]["astra"]["signed"] == pytest.approx(0.4)
    page = (tmp_path / "results/antmaze_u.md").read_text()
    assert "**ASTRA, seed 2**, chosen from 6 policies: predicted success 1.00 [1.00, 1.00]." in page
    assert "| ASTRA | 2 | 1.00 | 1.00 [1.00, 1.00] | 3 | 0.75 |" in page
    assert "| ASTRA | 3 | +0.40 | 0.40 |" in page and "| ASTRA+ | 3 | -0.58 | 0.58 |" in page
    assert "Regret of the chosen policy, in success in the target: 0.25; of a random policy: 0.29." in page
    assert "| select | 8 s | - |  |" in page
    manifest = read_manifest(root / "report")
    assert manifest and manifest.made_from["select"] == file_digest(root / "select/select.json")


def test_a_published_choice_stays_where_there_is_no_other(root: Path, tmp_path: Path) -> None:
    published = tmp_path / "results"
    write_choice(root)
    make(root, published)
    before = json.loads((published / "antmaze_u.json").read_text())["choice"]
    shutil.rmtree(root / "select")
    make(root, published, add_to=published / "antmaze_u.json")
    assert json.loads((published / "antmaze_u.json").read_text())["choice"] == before
    make(root, published)
    assert "choice" not in json.loads((published / "antmaze_u.json").read_text())


def test_how_failures_are_foreseen_is_drawn_of_the_largest_size(tasks: None, tmp_path: Path) -> None:
    """At the smaller one nothing tells failures."""
    rates = [(0.005, 0.0, 90)]
    foreseen = {"failures": 3, "auc": {"1-20": 0.9}, "brier_skill": 0.25, "reliability": rates}
    error = {"position_m": {"mean": [0.1], "low": [0.1], "high": [0.1]}}
    for percent, failures in ((50, {}), (100, {"failures": {"failure_model": foreseen}})):
        for seed in SEEDS:
            write_evaluation(tmp_path, "astra", seed, percent)
            ground = tmp_path / "ground/astra" / seed_folder(seed, percent)
            write_json(ground / "gap.json", {"horizons": [1], "grounded": error, "raw": error})
            spent = {"windows_per_second": 1.0, "wall_seconds": 1.0, "cpu_seconds": 1.0}
            write_json(ground / "metrics.json", spent | failures)
    make(tmp_path, recipe=FakeRecipe("sizes", methods=("astra",), percents=(50, 100)))
    page = read_page((tmp_path / "report/results.html").read_text())
    assert len(page.attributes("img")) == 1 + len(images(tmp_path / "report"))


def test_pictures_are_taken_in_seconds() -> None:
    camera = stage._camera(TASKS["humanoid-walker2d"])
    assert camera is not None and camera.timestep_s == 0.015
    assert camera.longest_s == pytest.approx(15.0)  # 1000 steps
    assert stage._camera(TASKS["antmaze-umaze"]) is None
