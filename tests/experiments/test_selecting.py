import json
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
from small_cart import TASK
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError
from astra_data.core.progress import silent
from astra_data.experiments.experiment import load_experiment
from astra_data.experiments.plan import plan
from astra_data.experiments.selecting import Candidate, select, worth
from astra_data.grounding.files import load_grounding
from astra_data.reports.artefacts import EVALUATION
from astra_data.training.simulator_env import SimulatorEnv

ROOT = Path(__file__).parents[2]
SMALL = """
[collect]
episodes = 8
max_steps = 40
start = "task"
hold_s = [0.1, 0.4]
[ground]
updates = 3
window = 5
held_out_share = 0.25
failure_members = 2
[train]
num_envs = 4
rollout_steps = 8
total_steps = 32
hidden_sizes = [8]
memory_size = 4
[evaluate]
episodes = 3
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seeds of two rows, trained and not tested."""
    place = tmp_path_factory.mktemp("select")
    path = place / "rail.toml"
    task = f'task = "{ROOT}/tests/small_cart.py:TASK"\n'
    path.write_text(f'{task}methods = ["direct_transfer", "nas"]\nseeds = [0, 1, 2]\n{SMALL}')
    experiment = load_experiment(path, place / "runs")
    for item in plan(experiment.recipe, path, experiment.folder):
        if item.key.split("/")[0] in ("collect", "pair", "ground", "train"):
            item.call(progress=silent)
    (experiment.folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    return experiment.folder


def test_each_policy_is_judged_by_the_groundings_of_other_seeds(folder: Path) -> None:
    ranked = select(folder, episodes=5)
    assert {(one.row, one.seed) for one in ranked} == {
        (row, seed) for row in ("direct_transfer", "nas") for seed in (0, 1, 2)
    }
    assert all(one.success.keys() == {0, 1, 2} - {one.seed} for one in ranked)
    scores = [(one.lower, one.predicted) for one in ranked]
    assert scores == sorted(scores, reverse=True)
    record = json.loads((folder / "select/select.json").read_text())
    assert [one["row"] for one in record["candidates"]] == [one.row for one in ranked]
    assert record["judge"] == "nas" and record["worth"] is None
    page = (folder / "select/select.md").read_text()
    assert page.count("| 2 | - |") == 6 and "Regret" not in page
    assert [one.row for one in select(folder, rows=["nas"], episodes=5)] == ["nas"] * 3


def test_a_judge_is_the_scattered_simulator_that_ends_episodes_by_its_failure_model(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def seen(world: SimulatorEnv, begin: object, horizon: int, seed: int) -> object:
        made.append((world, horizon, seed))
        raise StopIteration

    monkeypatch.setattr("astra_data.experiments.selecting.in_simulator", seen)
    with pytest.raises(StopIteration):
        select(folder, rows=["nas"], episodes=5)
    world, horizon, _ = made[0]
    grounding: Any = load_grounding(folder / "ground/nas/seed_1/grounding.safetensors")
    assert horizon == TASK.objective.horizon and world.num_envs == 5
    assert (world.simulator.scatter == grounding.model.residual_factor).all()
    assert world.topple == (grounding.failures is not None)


def test_the_figures_are_those_of_the_policies_in_these_simulators(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A policy that drives on reaches every goal within the horizon, where nothing fails."""
    for drives, success in ((True, 1.0), (False, 0.0)):

        def act(state: object, goal: object, drives: bool = drives) -> object:
            return goal * 0 + (0.5 if drives else -0.6)  # type: ignore[operator]

        told = "astra_data.training.deployment.DeployedPolicy.act_in_simulator"
        monkeypatch.setattr(told, lambda self, state, goal, act=act: act(state, goal))
        monkeypatch.setattr("astra_data.experiments.selecting.HistoryGrounding", int)
        found = select(folder, rows=["nas"], episodes=5)
        assert all(set(one.success.values()) == {success} for one in found)


def candidates(*figures: tuple[str, float, float | None]) -> list[Candidate]:
    return [Candidate(row, n, {9: lower}, target) for n, (row, lower, target) in enumerate(figures)]


def test_a_ranking_is_worth_its_rank_correlation_and_its_regret() -> None:
    a = [("a", 0.9, 0.3), ("a", 0.8, 0.2), ("a", 0.7, 0.1)]
    b = [("b", 0.6, 0.1), ("b", 0.5, 0.2), ("b", 0.4, 0.4)]
    found = worth(candidates(*a, *b))
    assert found is not None
    # Within a the order is right, within b it is reversed; between rows nothing counts.
    assert found["rank_correlation"] == pytest.approx(0.0)
    assert found["regret"] == pytest.approx(0.1)
    targets = [target for *_, target in a + b]
    assert found["random_regret"] == pytest.approx(0.4 - fmean(targets))
    assert worth(candidates(*a))["rank_correlation"] == pytest.approx(1.0)  # type: ignore[index]
    assert worth(candidates(*a[:2]))["rank_correlation"] is None  # type: ignore[index]
    assert worth(candidates(("a", 0.9, None))) is None


def test_the_lower_quartile_is_what_counts() -> None:
    liked_by_one = Candidate("a", 0, {1: 1.0, 2: 0.2, 3: 0.2, 4: 0.2, 5: 0.2})
    steady = Candidate("a", 1, {0: 0.3, 2: 0.3, 3: 0.3, 4: 0.3, 5: 0.3})
    assert liked_by_one.predicted > steady.predicted and liked_by_one.lower < steady.lower
    assert Candidate("a", 0, {1: 0.0, 2: 0.4}).lower == pytest.approx(0.1)


def test_the_target_is_told_where_it_was_tested(folder: Path) -> None:
    outcome = {"success": [1, 0, 0], "failed": [0, 0, 0], "wall_contact": [0.0] * 3, "steps": [5.0] * 3}
    place = folder / "evaluate/nas/seed_1"
    place.mkdir(parents=True)
    told = {"task": "t", "method": "nas", "seed": 1, "episodes": 3, "target": outcome | {"return": [1.0] * 3}}
    (place / EVALUATION).write_text(json.dumps(told))
    shown = CliRunner().invoke(app, ["select", str(folder), "--row", "nas", "--episodes", "5"])
    assert shown.exit_code == 0, shown.output
    assert "chosen: nas, seed " in shown.output and "select.md" in shown.output
    page = (folder / "select/select.md").read_text()
    assert "| 0.33 |" in page and "Regret of the first: 0.00; of one drawn at random: 0.00." in page
    assert "within rows: not known (fewer than three seeds)" in page
    (place / EVALUATION).unlink()


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            {"judge": "direct_transfer"},
            "expected a row that grounds its simulator as judge, got direct_transfer",
        ),
        ({"judge": "astra"}, "expected groundings of astra for two seeds or more, found 0"),
        ({"rows": ["astra"]}, "found no policy of astra: run the recipe until train first"),
        ({"rows": ["nothing"]}, "nothing"),
    ],
)
def test_what_is_not_there_is_asked_for(folder: Path, given: dict[str, object], told: str) -> None:
    with pytest.raises(BadInputError, match=told):
        select(folder, episodes=5, **given)  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match="expected the folder of a run"):
        select(folder / "nowhere")


def test_judges_of_the_same_episodes_are_told(folder: Path) -> None:
    select(folder, rows=["nas"], episodes=5)
    page = (folder / "select/select.md").read_text()
    assert "fitted to the episodes of other seeds" in page and "no judge is independent" not in page
    recipe = folder / "recipe.json"
    before = recipe.read_text()
    recipe.write_text(json.dumps(json.loads(before) | {"data": "logs@data-1.0.0"}))
    select(folder, rows=["nas"], episodes=5)
    page = (folder / "select/select.md").read_text()
    recipe.write_text(before)
    assert "fitted to the same episodes" in page and "no judge is independent of what it judges" in page
