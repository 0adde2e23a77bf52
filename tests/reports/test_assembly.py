import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from fake_runs import ROWS, SEEDS, FakeRecipe, edit_json, outcomes, write_choice, write_elsewhere, write_runs
from safetensors.numpy import load_file, save_file

from astra_data.core.errors import MissingStageError
from astra_data.reports.assembly import assemble
from astra_data.reports.page import hand_written, render
from astra_data.reports.schema import Results
from astra_data.worlds.score import RETURN, SUCCESS, SURVIVED_STEPS, Score


def assembled(
    root: Path,
    methods: tuple[str, ...] = ROWS,
    seeds: tuple[int, ...] = SEEDS,
    scores: tuple[Score, ...] = (SUCCESS,),
    published: Results | None = None,
) -> Results:
    return assemble(
        FakeRecipe(methods=methods, seeds=seeds),
        root=root,
        command="",
        replicates=10,
        scores=scores,
        published=published,
    )


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_runs(tmp_path)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return assembled(write_runs(tmp_path_factory.mktemp("assembly")))


def test_results_are_the_ones_worked_out_by_hand(results: Results) -> None:
    astra = results.methods["astra"]
    assert astra.success == [0.5, 0.25, 0.75]
    assert astra.failed == [0.5, 0.75, 0.25]
    assert astra.wall_contact == pytest.approx([0.1, 0.2, 0.3])
    assert astra.steps == [115.0, 115.0, 115.0]
    assert astra.returns == [0.0, 1.0, 2.0]
    assert astra.simulated_success == [0.75, 0.75, 0.75]
    assert astra.encoders == {"target": {"success": [0.5] * 3}, "source": {"success": [0.0, 0.1, 0.2]}}
    summary = astra.summary["success"]
    assert (summary.mean, summary.std, summary.iqm) == pytest.approx((0.5, 0.25, 0.5))
    assert summary.low is not None and summary.high is not None
    assert 0.25 <= summary.low < summary.high <= 0.75
    assert results.methods["follower"].simulated_success is None
    assert results.methods["follower"].learning == []
    assert (results.methods["direct_transfer"].role, results.methods["follower"].role) == ("floor", "ceiling")
    assert (results.seeds, results.episodes) == ([0, 1, 2], 4)


def test_the_papers_figures_are_those_of_reported_rows(root: Path) -> None:
    found = assemble(
        FakeRecipe(),
        root=root,
        command="",
        replicates=10,
        paper_success={"astra": 0.4, "nas": 0.27},
    )
    assert found.paper_success == {"astra": 0.4}


GROUND_SPEEDS = {
    "windows_per_second": {"astra": [0.0, 100.0, 200.0]},
    "episodes_per_second": {},
    "replays_per_second": {},
}


def test_plus_rows_share_the_grounding_of_their_base_row(results: Results) -> None:
    for row in ("astra", "astra_plus"):
        assert results.methods[row].grounding == "astra"
        gap = results.methods[row].gap
        assert gap is not None
        assert gap.horizons == [1, 10]
        assert gap.grounded["position_m"].mean == pytest.approx([0.2, 0.4])
        assert gap.grounded["position_m"].low == pytest.approx([0.1, 0.2])
        assert gap.grounded["position_m"].high[1] is None
        assert gap.raw["position_m"].mean == [1.0, 2.0]
    assert list(results.gaps()) == ["astra"]
    assert results.methods["direct_transfer"].gap is None
    assert results.throughput["ground"] == GROUND_SPEEDS
    assert results.throughput["evaluate"]["target_steps_per_second"]["astra"] == [1000.0, 1001.0, 1002.0]


def test_horizons_that_a_seed_lacks_are_left_out(root: Path) -> None:
    path = root / "ground/astra/seed_1/gap.json"
    only = {"mean": [0.2], "low": [0.1], "high": [0.3]}
    edit_json(path, horizons=[10], grounded={"position_m": only}, raw={"position_m": only})
    gap = assembled(root).gaps()["astra"]
    assert gap.horizons == [10]
    assert gap.grounded["position_m"].mean == pytest.approx([(0.2 + 0.2 + 0.6) / 3])


def test_each_row_has_the_seeds_that_it_has_finished(root: Path) -> None:
    shutil.rmtree(root / "evaluate/astra/seed_2")
    shutil.rmtree(root / "evaluate/astra_plus/seed_0")
    shutil.rmtree(root / "train/astra/seed_2")
    results = assembled(root)
    astra, plus = results.methods["astra"], results.methods["astra_plus"]
    assert (astra.seeds, plus.seeds, results.seeds) == ([0, 1], [1, 2], [0, 1, 2])
    assert (astra.success, plus.success) == ([0.5, 0.25], [0.75, 1.0])
    assert (len(astra.learning), len(plus.learning)) == (2, 2)
    # Together they have every seed of the grounding that they share.
    assert results.throughput["ground"] == GROUND_SPEEDS
    assert astra.gap is not None
    assert astra.gap.grounded["position_m"].mean == pytest.approx([0.2, 0.4])
    assert results.wall_seconds["evaluate"] == 10.0 * (3 + 2 + 2 + 3)
    # Direct transfer's seeds have 1/4, 0 and 1/4: the one of ASTRA with 1/4 ties twice.
    other = results.probability_of_improvement["astra"]["direct_transfer"]
    assert other.probability == pytest.approx((3 + 1 + 2 / 2) / 6)
    alone = assembled(root, seeds=(1,))
    assert alone.seeds == [1]
    assert alone.methods["astra"].success == [0.25]
    assert list(assembled(root, ("astra_plus",)).seeds) == [1, 2]


def test_rows_without_a_finished_seed_are_left_out_and_an_error_if_there_are_no_others(root: Path) -> None:
    for seed in SEEDS:
        (root / f"evaluate/astra/seed_{seed}/evaluation.json").unlink()
    (root / "evaluate/follower/seed_2/evaluation.json").unlink()
    results = assembled(root)
    assert list(results.methods) == [row for row in ROWS if row != "astra"]
    assert results.unfinished == ["ASTRA"]
    with pytest.raises(MissingStageError) as error:
        assembled(root, ("astra",))
    message = str(error.value)
    assert "found none for astra seed 0, 1, 2; run" in message
    assert "run the recipe antmaze_u again: it continues with what is missing" in message
    with pytest.raises(MissingStageError, match="follower seed 2; run"):
        assembled(root, ("follower",), (2,))


def test_a_grounding_of_some_finished_seeds_only_is_missing(root: Path) -> None:
    (root / "ground/astra/seed_2/gap.json").unlink()
    with pytest.raises(
        MissingStageError,
        match=r"expected gap.json .* none for astra seed 2; astra_plus seed 2; run the recipe",
    ):
        assembled(root)
    for row in ("astra", "astra_plus"):
        shutil.rmtree(root / f"evaluate/{row}/seed_2")
    assert assembled(root).methods["astra"].seeds == [0, 1]


def test_a_hand_written_row_has_the_success_of_the_grounded_simulator(root: Path) -> None:
    """It was trained in none, and tells what that one allows."""
    for seed in (0, 1, 2):
        path = root / f"evaluate/follower/seed_{seed}/evaluation.json"
        edit_json(path, grounded=outcomes([1, 0, 0, 0], seed))
    found = assembled(root)
    assert found.methods["follower"].simulated_success == [0.25] * 3
    assert hand_written(found) == "the careful follower"
    told = "How well the careful follower does in the grounded simulator shows whether that simulator allows"
    assert told in render(found, {}) and "0.25 ± 0.00 |" in render(found, {})
    assert "follower" not in found.probability_of_improvement["astra"]
    write_elsewhere(root, "iql")
    edit_json(root / "evaluate/iql/seed_0/evaluation.json", grounded=outcomes([1, 0, 0, 0], 0))
    assert assembled(root, ("iql",), (0,)).methods["iql"].simulated_success is None


def test_seeds_tell_their_tries_and_commands_beyond_the_data_and_curves_what_is_scored(root: Path) -> None:
    for seed in SEEDS:
        edit_json(root / f"evaluate/astra/seed_{seed}/evaluation.json", beyond_recorded=0.1 * seed)
        points = [{"steps": 9, "success": None, "episode_steps": lasted} for lasted in (None, 30.0 + seed)]
        tries = [{"seed": number} for number in range(seed + 1)]
        edit_json(root / f"train/astra/seed_{seed}/curve.json", points=points, tries=tries)
    row = assembled(root, ("astra",), scores=(SURVIVED_STEPS, RETURN)).methods["astra"]
    assert row.tries == [1.0, 2.0, 3.0] and row.beyond_recorded == pytest.approx([0.0, 0.1, 0.2])
    assert [curve.score for curve in row.learning] == [
        pytest.approx([np.nan, 30.0 + n], nan_ok=True) for n in SEEDS
    ]


def leave_out_the_target(root: Path) -> None:
    """Let ASTRA have been tested in the grounded simulator alone."""
    for seed in SEEDS:
        folder = root / f"evaluate/astra/seed_{seed}"
        edit_json(folder / "evaluation.json", tested_in="grounded", target=None)
        tensors = load_file(folder / "trajectories.safetensors")
        tensors["grounded.position"] = tensors["target.position"]
        save_file(tensors, folder / "trajectories.safetensors")


def test_a_choice_is_of_the_seeds_that_are_asked_for_and_measured_in_the_target_alone(root: Path) -> None:
    write_choice(root)
    choice = assembled(root, ("astra",), (0, 1)).choice
    assert choice is not None and [(one.seed, one.target) for one in choice.candidates] == [
        (0, 0.5),
        (1, 0.25),
    ]
    leave_out_the_target(root)
    for rows in (("astra",), ("astra", "astra_plus")):
        found = assembled(root, rows)
        assert found.tested_in == "simulators" and found.choice is not None
        assert not any(one.target for one in found.choice.candidates)


def test_a_choice_among_some_of_the_published_policies_is_left_out(root: Path) -> None:
    rows = ("astra", "astra_plus")
    published = assembled(root, rows)
    write_choice(root)
    whole = assembled(root, rows, published=published).choice
    assert whole is not None and len(whole.candidates) == 6
    candidates = json.loads((root / "select/select.json").read_text())["candidates"]
    for some in (candidates[:3], candidates[:5]):  # a row, and all but a seed
        edit_json(root / "select/select.json", candidates=some)
        assert assembled(root, rows, published=published).choice is None
        chosen = published.model_copy(update={"choice": whole})
        assert assembled(root, rows, published=chosen).choice == whole
        assert assembled(root, rows).choice is not None


def test_a_row_that_was_in_no_simulator_has_no_success_there(root: Path) -> None:
    write_elsewhere(root, "iql")
    row = assembled(root, ("iql",)).methods["iql"]
    assert row.simulated_success is None and "simulated_success" not in row.summary
    assert np.isnan(row.learning[0].score).all()
    assert row.simulator_returns["raw"] == [0.0, 1.0, 4.0]


def test_legs_of_the_target_are_those_of_the_evaluations(root: Path) -> None:
    for seed in SEEDS:
        edit_json(root / f"evaluate/astra/seed_{seed}/evaluation.json", leg_scale=1.25)
    assert assembled(root, ("astra",)).leg_scale == 1.25


def test_what_foretells_no_target_has_no_validity(root: Path) -> None:
    leave_out_the_target(root)
    assert assembled(root, ("astra",)).predictive_validity == {}


def test_who_stands_still_is_told_where_all_seeds_have_measured_it(root: Path) -> None:
    files = [root / f"ground/astra/seed_{seed}/gap.json" for seed in SEEDS]
    for number, file in enumerate(files, start=1):
        gap = json.loads(file.read_text())
        file.write_text(json.dumps(gap | {"still": gap["raw"]}))
        found = assembled(root).methods["astra"].gap
        assert found is not None
        assert found.still == (found.raw if number == len(files) else None)


@pytest.mark.parametrize("is_a_row", [True, False])
def test_fine_tuning_costs_the_training_that_it_starts_from_too(root: Path, is_a_row: bool) -> None:
    write_elsewhere(root, "direct_transfer_iql")
    for seed in SEEDS:
        path = root / f"train/direct_transfer/seed_{seed}/curve.json"
        edit_json(path, wall_seconds=1000.0, cpu_seconds=900.0)
    rows = ("direct_transfer", "direct_transfer_iql") if is_a_row else ("direct_transfer_iql",)
    results = assembled(root, rows)
    cost = results.methods["direct_transfer_iql"].cost["train"]
    assert (cost.wall_seconds, cost.cpu_seconds) == (1003.0, None)  # fine-tuning recorded no processor time
    for seed in SEEDS:
        edit_json(root / f"train/direct_transfer_iql/seed_{seed}/curve.json", cpu_seconds=2.0)
    assert assembled(root, rows).methods["direct_transfer_iql"].cost["train"].cpu_seconds == 902.0
    assert results.wall_seconds["train"] == 3 * 1003.0
