import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_dataset import write_fake
from fake_report import CONFIG, FIGURES, make
from fake_runs import (
    MADE,
    ROWS,
    SEEDS,
    FakeRecipe,
    edit_json,
    outcomes,
    write_elsewhere,
    write_evaluation,
)

from astra_data.core.errors import BadInputError
from astra_data.core.naming import place
from astra_data.reports.sizes import SizesResults
from astra_data.stages.report import report


@pytest.fixture
def values(folder: Path) -> Any:  # noqa: ANN401 - JSON
    return json.loads((folder / "results.json").read_text())


def test_a_list_of_numbers_takes_one_line(folder: Path) -> None:
    assert '"success": [ 0.5, 0.25, 0.75 ]' in (folder / "results.json").read_text()


def test_json_uses_the_names_of_the_artefacts(values: Any) -> None:  # noqa: ANN401 - JSON
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


def test_a_paper_figure_of_no_row_is_refused(root: Path) -> None:
    config = CONFIG.model_copy(update={"paper_success": {"astar": 0.4}})
    with pytest.raises(BadInputError, match="astar"):
        report(FakeRecipe(), root=root, command="", publish=None, progress=lambda *_: None, config=config)


def test_origin_is_what_the_artefacts_recorded(values: Any, folder: Path) -> None:  # noqa: ANN401 - JSON
    assert values["command"] == "astra-data run recipes/antmaze_u.toml"
    made, drawn = values["origins"]
    assert made["stages"] == ["collect", "pair", "ground", "train", "evaluate"]
    assert made["commit"] == "abc-dirty"
    assert (made["machine"], made["packages"]) == (MADE["machine"], MADE["packages"])
    assert drawn["stages"] == ["report"]
    assert drawn["packages"]["numpy"] == np.__version__
    page = (folder / "results.md").read_text()
    assert "on Fast, 8 cores, 16 GiB of memory, H200. Wall time" in page
    assert "- Code: commit `abc` with uncommitted changes (collect, pair, ground, train, evaluate); " in page
    assert "- Versions: torch 2.0.0 (collect, pair, ground, train, evaluate); python " in page
    first = {"name": "antmaze-u-random", "version": "data-1.0.0", "content_hash": "hash0"}
    assert values["datasets"][0] == first | {"stage": "collect", "seed": 0}
    trained, follower = values["evaluated_with"]
    assert trained["hashes"] == ["hash0", "hash1", "hash2"]
    assert follower == {"versions": [None] * 3, "hashes": [None] * 3, "methods": ["follower"]}


def test_a_row_that_was_in_no_simulator_is_reported(root: Path) -> None:
    write_elsewhere(root, "iql")
    make(root, recipe=FakeRecipe(methods=("iql", "follower")))
    page = (root / "report/results.md").read_text()
    assert "| IQL | 3 | **0.17 ± 0.14** |" in page
    assert "| IQL | - | 3 s | - | 10 s | 13 s | - |" in page
    assert not (root / "report/learning.png").exists()


def test_publishing_copies_all_under_the_recipes_name(root: Path, tmp_path: Path) -> None:
    published = tmp_path / "results"
    make(root, published)
    figures = {f"antmaze_u_{name}.png" for name in FIGURES}
    assert {path.name for path in published.iterdir()} == figures | {"antmaze_u.json", "antmaze_u.md"}
    assert "](antmaze_u_mismatch.png)" in (published / "antmaze_u.md").read_text()


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


def test_there_must_be_results_to_add_to(root: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"expected published results in .*antmaze_u.json, found none"):
        make(root, add_to=tmp_path / "antmaze_u.json")
    (tmp_path / "antmaze_u.json").write_text("{}")
    with pytest.raises(BadInputError, match=r"antmaze_u.json does not hold results as they are written now"):
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


def test_a_cut_off_trajectory_file_is_refused(root: Path) -> None:
    path = root / "evaluate/astra/seed_0/trajectories.safetensors"
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(BadInputError, match="no whole safetensors file"):
        make(root)


def test_sizes_are_set_side_by_side(tasks: None, tmp_path: Path) -> None:
    root = tmp_path / "runs" / "sizes"
    for percent in (50, 100):
        for seed in SEEDS:
            write_evaluation(root, "astra", seed, percent)
            write_evaluation(root, "direct_transfer", seed, percent)
            write_fake(root / "subset" / place(seed, percent))
    # At 50 % one seed of ASTRA is worse.
    path = root / "evaluate/astra" / place(2, 50) / "evaluation.json"
    edit_json(path, target=outcomes([0, 0, 0, 0], 2))
    sized = FakeRecipe("sizes", methods=("direct_transfer", "astra"), percents=(50, 100))
    make(root, tmp_path / "results", sized)
    found = SizesResults.model_validate_json((root / "report/results.json").read_text())
    success = {size.percent: size.results.methods["astra"].success for size in found.sizes}
    assert success == {50: [0.5, 0.25, 0.0], 100: [0.5, 0.25, 0.75]}
    assert [dataset.stage for dataset in found.sizes[0].results.datasets] == ["subset"] * 3
    page = (root / "report/results.md").read_text()
    assert "| method | 50 % | 100 % |" in page
    assert "| ASTRA | 0.25 ± 0.25 | 0.50 ± 0.25 |" in page
    assert (root / "report/data_efficiency.png").stat().st_size > 0
    published = (tmp_path / "results/sizes.md").read_text()
    assert "](sizes_data_efficiency.png)" in published
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == [
        "sizes.json",
        "sizes.md",
        "sizes_data_efficiency.png",
    ]
