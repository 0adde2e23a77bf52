"""The report over small runs, one of each kind: what it writes where, and what stands on its pages."""

import logging
import shutil
from base64 import b64decode
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fake_dataset import write_fake
from fake_runs import (
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

from astra_data.core.artifact import read_manifest
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError, MissingStageError
from astra_data.core.naming import artifact_key
from astra_data.pipeline.stages import report as stage
from astra_data.pipeline.stages.report import ReportConfig, report
from astra_data.reports.figures import catalog as figures
from astra_data.reports.results import Results, read_results
from astra_data.worlds.objective import RETURN, SUCCESS, SURVIVED_STEPS
from astra_data.worlds.plane.mazes import U_MAZE

DRAWN = figures.drawn
REPLAY = (np.arange(4, dtype=np.float64), np.zeros((4, 2)), np.zeros((4, 4)), np.zeros((2, 4, 4)))
FIGURES = {"success", "trajectories", "mismatch", "learning", "gap", "validity"}
CONFIG = ReportConfig(trajectory_episodes=2)
COMMAND = "astra-data run recipes/antmaze_u.toml"


def task(**changes: object) -> SimpleNamespace:
    usual: dict[str, object] = {
        "name": "antmaze-u",
        "plane": U_MAZE,
        "ball_index": None,
        "facts": {},
        "timestep_s": 0.1,
    }
    objective = SimpleNamespace(scores=(SUCCESS,), action_size=2, horizon=100)
    return SimpleNamespace(**usual | {"objective": objective, "make_target": object()} | changes)


def images(folder: Path) -> set[str]:
    return {path.stem for path in folder.glob("*.png")}


def make(
    root: Path,
    publish: Path | None = None,
    recipe: FakeRecipe | None = None,
    published: tuple[Path, ...] = (),
    config: ReportConfig = CONFIG,
) -> Results:
    """Write the report, and return its results."""
    report(recipe or FakeRecipe(), root=root, command=COMMAND, publish=publish, published=published, config=config)
    return read_results(root / "report/results.json")


@pytest.fixture(autouse=True)
def known_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the report a task of its own, and no figures, which take seconds."""
    monkeypatch.setattr(stage, "task_named", {"antmaze-u": task()}.__getitem__)
    monkeypatch.setattr("astra_data.reports.figures.catalog.drawn", lambda *_: {})


@pytest.fixture
def rough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw figures, quickly, and without a target to replay commands in."""

    def png(figure: Figure) -> bytes:
        figure.set_layout_engine("none")
        figure.savefig(content := BytesIO(), format="png", dpi=20)
        return content.getvalue()

    monkeypatch.setattr("astra_data.reports.figures.catalog.drawn", DRAWN)
    monkeypatch.setattr("astra_data.reports.figures.motion.replay_commands", lambda _: REPLAY)
    monkeypatch.setattr("astra_data.reports.figures.catalog.png", png)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_runs(tmp_path)


@pytest.fixture
def target(root: Path) -> Iterator[str]:
    make(root)
    yield (root / "report/results.md").read_text()


def test_a_report_is_complete_and_its_pages_say_the_same(rough: None, root: Path, target: str) -> None:
    folder = root / "report"
    assert images(folder) == FIGURES and {name for name in FIGURES if f"]({name}.png)" in target} == FIGURES
    html = read_page((folder / "results.html").read_text())
    inlined = [b64decode((image["src"] or "").partition("base64,")[2]) for image in html.attributes("img")]
    assert sorted(inlined) == sorted(path.read_bytes() for path in folder.glob("*.png"))
    for text in ("Deploy", "0.92 ± 0.14", "--row astra_plus --seed 0", COMMAND, "floor", "Every seed"):
        assert text in target and text in html.text
    assert "select" not in target
    manifest = read_manifest(folder)
    assert manifest and manifest.faults(folder, verify=True) == []
    evaluations = {path.parent: path for path in root.glob("evaluate/*/*/evaluation.json")}
    digests = {str(key.relative_to(root)): file_digest(path) for key, path in evaluations.items()}
    assert evaluations and manifest.made_from.items() >= digests.items()


def test_the_table_of_methods_has_the_targets_column_first(target: str) -> None:
    lines = [line.strip("| ").split(" | ") for line in target.splitlines() if line.startswith("| ")]
    head = next(line for line in lines if line[0] == "method")
    assert head[:4] == ["method", "success in the target", "95 % interval", "in its simulator"]
    table = {line[0]: dict(zip(head, line, strict=True)) for line in lines if len(line) == len(head)}
    astra, plus = table["ASTRA"], table["**ASTRA+**"]
    assert (astra["success in the target"], astra["in its simulator"]) == ("0.50 ± 0.25", "0.75 ± 0.00")
    assert (astra["lost"], astra["failed"], astra["seeds"]) == ("0.25", "0.50 ± 0.25", "3")
    assert plus["path length to success (m)"] == "8.0 ± 0.0"
    assert table["Careful follower (ceiling)"]["in its simulator"] == "-" and "Direct transfer (floor)" in table


def test_intervals_and_probabilities_of_improvement_need_three_seeds(root: Path, target: str) -> None:
    assert "| ASTRA | Direct transfer | 0.89 [" in target
    make(root, recipe=FakeRecipe(seeds=(0, 1)))
    for name in ("results.md", "results.html"):
        page = (root / "report" / name).read_text()
        assert "Probability of improvement" not in page and "need 3 seeds, ASTRA+ has 2" in page


def test_predicted_failures_are_reported(root: Path) -> None:
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
    line = page.table("Failures, predicted on held-out episodes")[1]
    assert line[:3] == ["ASTRA: failure model", "12", "0.90"] and line[-2:] == ["0.25", "0.50 of 0.40"]


def draw_only(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "FIGURES", {name: figures.FIGURES[name]})


def test_publishing_adds_to_what_is_there(
    rough: None, root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw_only("trajectories", monkeypatch)
    results = tmp_path / "results"
    folder = results / "antmaze_u"
    file = folder / "results.json"
    make(root, results, FakeRecipe(seeds=(0, 1)))
    assert {path.name for path in folder.iterdir()} == {"trajectories.png", "results.json", "results.md"}
    drawn = (folder / "trajectories.png").read_bytes()
    for row in ROWS:
        for seed in (0, 1):
            shutil.rmtree(root / f"evaluate/{row}/seed_{seed}")
    shutil.rmtree(root / "evaluate/astra_plus")
    make(root, results, published=(file,))
    found = read_results(file)
    assert found.values("astra", "success") == {0: 0.5, 1: 0.25, 2: 0.75}
    assert found.values("astra_plus", "success") == {0: 1.0, 1: 0.75}
    page = (folder / "results.md").read_text()  # the trajectories of ASTRA+ are not here: the figure stays as it is
    assert "](trajectories.png)" in page and (folder / "trajectories.png").read_bytes() == drawn
    assert not caplog.records
    # A changed result replaces the earlier one, and it is said.
    edit_json(root / "evaluate/astra/seed_2/evaluation.json", target=outcomes([0, 0, 0, 0], 2))
    with caplog.at_level(logging.WARNING):
        make(root, results, FakeRecipe(methods=("astra",)), published=(file,))
    assert "new results replace those of astra seed 2 (success 0.75, now 0)" in caplog.text
    assert read_results(file).values("astra_plus", "success") == {0: 1.0, 1: 0.75}
    (tmp_path / "broken.json").write_text("{}")
    with pytest.raises(BadInputError, match=r"broken.json is not what the report writes"):
        make(root, published=(tmp_path / "broken.json",))


def test_a_choice_without_the_target_is_reported_and_stays_published(root: Path, tmp_path: Path) -> None:
    write_choice(root)
    tried = [{"row": row, "seed": seed, "success": [1, 1]} for row, seed in (("astra", 2), ("astra_plus", 0))]
    rounds = [{"trials": 2, "candidates": [("astra", 2), ("astra_plus", 0)], "tried": tried}]
    trials = {"trials": 4, "field": 2, "pseudo_trials": 4, "rounds": rounds}
    write_json(root / "select/trials.json", trials | {"chosen": ("astra_plus", 0), "rate": (1.0, 0.25, 1.0)})
    make(root, tmp_path / "results")
    page = (tmp_path / "results/antmaze_u/results.md").read_text()
    in_target = "**ASTRA+, seed 0**: success 1.00 [0.25, 1.00]."
    assert f"- 4 trials in the target choose {in_target}\n" in page
    assert f"## Trials in the target\n\n{in_target} 4 of 4 episodes" in page
    assert "**ASTRA, seed 2**, chosen from 6 policies: predicted success 1.00 [" in page
    assert "| ASTRA | 3 | +0.40 | 0.40 |" in page and "| ASTRA+ | 3 | -0.58 | 0.58 |" in page
    # ASTRA has 0.5, 0.25 and 0.75 in the target, its ranks are right; the best there is ASTRA+ with 1.
    assert "Regret of the chosen policy, in success in the target: 0.25; of a random policy: 0.29." in page
    assert "| select | 8 s | - |" in page
    manifest = read_manifest(root / "report")
    assert manifest and manifest.made_from["select"] == file_digest(root / "select/select.json")
    # Trials of what is not reported say nothing there; nor do they fail, where they go on.
    write_json(root / "select/trials.json", trials)
    make(root, recipe=FakeRecipe(methods=("astra",)))
    assert "Trials" not in (root / "report/results.md").read_text()
    shutil.rmtree(root / "select")
    make(root, tmp_path / "results", published=(tmp_path / "results/antmaze_u/results.json",))
    page = (tmp_path / "results/antmaze_u/results.md").read_text()
    assert "**ASTRA, seed 2**, chosen from 6" in page and "## Trials in the target" in page


def test_sizes_are_set_side_by_side(rough: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw_only("data_efficiency", monkeypatch)
    root = tmp_path / "runs" / "sizes"
    for percent in (50, 100):
        for seed in SEEDS:
            write_evaluation(root, "astra", seed, percent)
            write_fake(root / artifact_key("subset", "", seed, percent))
    for seed in SEEDS[:2]:
        write_evaluation(root, "direct_transfer", seed, 100)
    path = root / artifact_key("evaluate", "astra", 2, 50) / "evaluation.json"  # at 50 % one seed of ASTRA is worse
    edit_json(path, target=outcomes([0, 0, 0, 0], 2))
    asked = {"seeds": [*SEEDS, 7], "sweep": {"percent": [10, 100, 50]}}
    sized = FakeRecipe(name="sizes", methods=("direct_transfer", "astra"), percents=(10, 100, 50), settings=asked)
    assert make(root, tmp_path / "results", sized).percents == [50, 100]
    html = read_page((root / "report/results.html").read_text())
    head, direct, astra = html.table("Success in the target, mean")
    assert (head, astra) == (["method", "50 %", "100 %"], ["ASTRA", "0.25 ± 0.25", "0.50 ± 0.25"])
    assert direct == ["Direct transfer", "-", "0.12 ± 0.18 (2 of 3 seeds)"]
    assert (
        "Not finished yet: Direct transfer at 50 %; 10 % of the data; seeds 7." in html.text
        and "data_efficiency" in images(root / "report")
    )
    assert (tmp_path / "results/sizes/data_efficiency.png").exists()


def test_lasting_tasks_are_reported_by_survived_steps_and_return(
    rough: None, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    objective = SimpleNamespace(scores=(SURVIVED_STEPS, RETURN), horizon=1000)
    lasting = task(plane=None, objective=objective, make_target=None)
    monkeypatch.setattr(stage, "task_named", {"antmaze-u": lasting}.__getitem__)
    for seed, steps in enumerate((60.0, 90.0, 600.0)):
        edit_json(
            root / f"evaluate/astra/seed_{seed}/evaluation.json",
            target=outcomes([0, 0, 0, 1], seed) | {"steps": [steps] * 4},
        )
        points = [{"steps": at, "success": None, "episode_steps": at / 10} for at in (100, 200)]
        edit_json(root / f"train/astra/seed_{seed}/curve.json", points=points)
    found = make(root)
    page = (root / "report/results.md").read_text()
    assert "| method | survived steps in the target | 95 % interval | return in the target |" in page
    assert "| **ASTRA** | 250 ± 303 |" in page
    assert images(root / "report") == {"steps", "return", "learning", "gap", "validity", "trajectories"}
    assert found.trainings[-1].score != [] and [10.0, 20.0] in [one.score for one in found.trainings]
    objective.scores = (RETURN,)  # which no learning curve has
    assert np.isnan([value for one in make(root).trainings for value in one.score]).all()


def test_what_no_target_tested_is_said_before_all_else(root: Path) -> None:
    for path in root.glob("evaluate/*/*/evaluation.json"):
        edit_json(path, target=None, tested_in="raw")
        if "follower" in path.parts:
            path.unlink()
    for path in root.glob("evaluate/*/*/trajectories.safetensors"):
        path.unlink()
    make(root, recipe=FakeRecipe(methods=ROWS[:3]))
    page = (root / "report/results.md").read_text()
    assert page.splitlines()[2].startswith("> **Nothing was tested on a robot: the task has no target.**")
    assert "Try first" in page and "Does a simulator show" not in page


def test_a_robot_that_is_a_stand_in_and_code_of_the_users_are_named(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stage, "task_named", {"antmaze-u": task(facts={"stand_in": "mujoco"})}.__getitem__)
    digests = {"task": "0a", "astra": "1b", "astra.settings": "{}", "gone": "2c"}
    write_json(root / "code.json", digests)
    assert make(root).user_code == {"task": "0a", "astra": "1b"}
    page = (root / "report/results.md").read_text()
    assert "**A simulated stand-in (`mujoco`) replaces the physical robot" in page
    assert "- User code: task `0a`, astra `1b`." in page
    assert "- Code: commit `abc` with uncommitted changes (evaluate, train, ground, collect, pair);" in page


def test_methods_without_simulator_or_seeds_and_datasets_are_reported(root: Path) -> None:
    write_elsewhere(root, "iql")
    made = {"name": "antmaze-u-random", "version": "data-2.0.0", "content_hash": "hash"}
    write_json(root / "label/seed_1/meta/astra/dataset.json", made | {"wall_seconds": 11.0})
    found = make(root, recipe=FakeRecipe(methods=("iql", "nas", "follower"), seeds=(1, 9)))
    assert [(one.stage, one.seed) for one in found.datasets if one.version == "data-2.0.0"] == [("label", 1)]
    page = (root / "report/results.md").read_text()
    assert "| IQL | - | 3 s | - | 10 s | 13 s | 20 s |" in page and "| label | 11 s |" in page
    assert "Not finished yet: NAS." in page


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "antmaze-long"}, "seed 1 on antmaze-long with 4 episodes"),
        ({"leg_scale": 1.25}, "legs 1.25 times as long"),
        ({"seed": None}, r"evaluation.json is not .*seed: "),
    ],
)
def test_what_cannot_stand_in_one_table_is_refused(root: Path, changes: dict[str, object], message: str) -> None:
    edit_json(root / "evaluate/astra/seed_1/evaluation.json", **changes)
    with pytest.raises(BadInputError, match=message):
        make(root)
    shutil.rmtree(root / "evaluate")
    with pytest.raises(MissingStageError, match="found none for direct_transfer, astra"):
        make(root)
    assert not (root / "report").exists()
