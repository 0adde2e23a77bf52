import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_dataset import write_fake
from safetensors.numpy import save_file

from astra_data.errors import BadInputError, MissingStageError
from astra_data.mazes import U_MAZE
from astra_data.mismatch import CommandReplay
from astra_data.results import assembly
from astra_data.results.model import Results
from astra_data.results.sizes import SizesResults
from astra_data.rows import place
from astra_data.stages import report as stage
from astra_data.stages.report import ReportConfig, report

ROWS = ("direct_transfer", "astra", "astra_plus", "follower")
SEEDS = (0, 1, 2)
SUCCESS = {
    "direct_transfer": ([1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0]),
    "astra": ([1, 1, 0, 0], [1, 0, 0, 0], [1, 1, 1, 0]),
    "astra_plus": ([1, 1, 1, 1], [1, 1, 1, 0], [1, 1, 1, 1]),
    "follower": ([1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 1]),
}
"""Row → seed → episode."""

MADE = {
    "git_commit": "abc-dirty",
    "packages": {"torch": "2.0.0"},
    "machine": {"cpu": "Fast", "cores": 8, "memory_gib": 16.0, "gpu": "H200"},
}

REPLAY = CommandReplay(
    np.arange(4, dtype=np.float64), np.zeros((4, 2)), np.zeros((4, 4)), np.zeros((2, 4, 4))
)

CONFIG = ReportConfig(bootstrap_replicates=100, trajectory_episodes=2)


@dataclass(frozen=True)
class FakeRecipe:
    name: str = "antmaze_u"
    task: str = "antmaze-u"
    methods: tuple[str, ...] = ROWS
    seeds: tuple[int, ...] = SEEDS
    groundings: Mapping[str, str] = field(default_factory=dict)
    percents: tuple[int, ...] = ()


def write_json(path: Path, values: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values))


def edit_json(path: Path, **changes: object) -> None:
    write_json(path, json.loads(path.read_text()) | changes)


def outcomes(success: list[int], seed: int) -> dict[str, list[float]]:
    count = len(success)
    return {
        "success": [float(value) for value in success],
        "topple": [1.0 - value for value in success],
        "wall_contact": [0.1 * (seed + 1)] * count,
        "steps": [100.0 + 10 * episode for episode in range(count)],
        "return": [float(seed)] * count,
    }


def write_evaluation(root: Path, method: str, seed: int, percent: int | None = None) -> None:
    folder = root / "evaluate" / method / place(seed, percent)
    values: dict[str, object] = {
        "task": "antmaze-u",
        "method": method,
        "seed": seed,
        "episodes": 4,
        "dataset_version": None if method == "follower" else "antmaze-u-random@data-1.0.0",
        "dataset_hash": None if method == "follower" else f"hash{seed}",
        **MADE,
        "wall_seconds": 10.0,
        "target_steps_per_second": 1000.0 + seed,
        "encoder": "target",
        "target": outcomes(SUCCESS[method][seed], seed),
    }
    if method != "follower":
        values["simulated"] = outcomes([1, 1, 1, 0], seed)
    if method.startswith("astra"):
        values["encoders"] = {"target": {"success": 0.5}, "source": {"success": 0.1 * seed}}
    write_json(folder / "evaluation.json", values)
    positions = np.full((4, 6, 2), np.nan, dtype=np.float32)
    positions[:, :5] = np.linspace([-4, 4], [4, 4], 5)
    tensors = {"target.position": positions, "start": positions[:, 0].copy(), "goal": positions[:, 4].copy()}
    if method != "follower":
        tensors["simulated.position"] = positions
    save_file(tensors, folder / "trajectories.safetensors")


def band(error: float) -> dict[str, list[float]]:
    return {
        "mean": [error, 2 * error],
        "low": [error / 2, error],
        "high": [2 * error, float("nan")],
    }


@pytest.fixture(scope="module", autouse=True)
def tasks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage, "TASKS", {"antmaze-u": SimpleNamespace(maze=U_MAZE)})
        patch.setattr(stage, "replay_commands", lambda task: REPLAY)
        yield


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_runs(tmp_path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a finished report, for tests that only read it."""
    root = write_runs(tmp_path_factory.mktemp("report"))
    make(root)
    return root / "report"


@pytest.fixture
def values(folder: Path) -> Any:  # noqa: ANN401 - JSON
    return json.loads((folder / "results.json").read_text())


@pytest.fixture
def results(folder: Path) -> Results:
    return Results.model_validate_json((folder / "results.json").read_text())


def write_runs(parent: Path) -> Path:
    """Write the runs of a small recipe: ASTRA+ shares ASTRA's grounding, the follower learns nothing."""
    root = parent / "runs" / "antmaze_u"
    for seed in SEEDS:
        identity = {"name": "antmaze-u-random", "version": "data-1.0.0", "content_hash": f"hash{seed}"}
        took = {"wall_seconds": 5.0, "target_steps_per_second": 2000.0 * (seed + 1)}
        write_json(root / f"collect/seed_{seed}/meta/astra/dataset.json", identity | MADE | took)
        write_json(root / f"pair/seed_{seed}/meta/astra/dataset.json", identity | MADE)
        ground = root / f"ground/astra/seed_{seed}"
        metrics = {"windows_per_second": 100.0 * seed, "wall_seconds": 7.0, "epochs": []}
        write_json(ground / "metrics.json", metrics | MADE)
        grounded, raw = {"position_m": band(0.1 * (seed + 1))}, {"position_m": band(1.0)}
        write_json(ground / "gap.json", {"horizons": [1, 10], "grounded": grounded, "raw": raw})
        for method in ROWS:
            write_evaluation(root, method, seed)
            if method != "follower":
                points = [
                    {"steps": 0, "success": None, "entropy": 1.0},
                    {"steps": 1000, "success": 0.5, "entropy": 0.5},
                    {"steps": 2000, "success": 0.75, "entropy": 0.2},
                ]
                write_json(
                    root / f"train/{method}/seed_{seed}/curve.json",
                    MADE
                    | {
                        "steps_per_second": 48000.0,
                        "simulator_steps_per_second": 96000.0,
                        "points": points,
                    },
                )
    return root


def make(root: Path, publish: Path | None = None, recipe: FakeRecipe | None = None) -> None:
    notes: list[tuple[float, str]] = []
    report(
        recipe or FakeRecipe(),
        root=root,
        command="astra-data run recipes/antmaze_u.toml",
        publish=publish,
        progress=lambda fraction, note: notes.append((fraction, note)),
        config=CONFIG,
    )
    assert notes[-1] == (1.0, "best: Careful follower  success 1.00") or recipe


def test_results_are_the_ones_worked_out_by_hand(results: Results) -> None:
    astra = results.methods["astra"]
    assert astra.success == [0.5, 0.25, 0.75]
    assert astra.topple == [0.5, 0.75, 0.25]
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


def test_a_list_of_numbers_takes_one_line(folder: Path) -> None:
    assert '"success": [ 0.5, 0.25, 0.75 ]' in (folder / "results.json").read_text()


def test_json_uses_the_names_of_the_artefacts(values: Any) -> None:  # noqa: ANN401 - JSON
    row = values["methods"]["astra"]
    assert row["return"] == [0.0, 1.0, 2.0]
    assert set(row["summary"]) == {
        "success",
        "topple",
        "wall_contact",
        "steps",
        "return",
        "simulated_success",
    }
    assert set(row["summary"]["success"]) == {"mean", "std", "iqm", "low", "high"}
    learning = {"steps": [0.0, 1000.0, 2000.0], "success": [None, 0.5, 0.75]}
    assert row["learning"] == [learning] * 3


def test_plus_rows_share_the_grounding_of_their_base_row(results: Results) -> None:
    for row in ("astra", "astra_plus"):
        assert results.methods[row].grounding == "astra"
        gap = results.methods[row].gap
        assert gap is not None
        assert gap.horizons == [1, 10]
        assert gap.grounded["position_m"].mean == pytest.approx([0.2, 0.4])
        assert gap.grounded["position_m"].low == pytest.approx([0.1, 0.2])
        assert np.isnan(gap.grounded["position_m"].high[1])
        assert gap.raw["position_m"].mean == [1.0, 2.0]
    assert list(results.gaps()) == ["astra"]
    assert results.methods["direct_transfer"].gap is None
    assert results.throughput["ground"] == {"windows_per_second": {"astra": [0.0, 100.0, 200.0]}}
    assert results.throughput["evaluate"]["target_steps_per_second"]["astra"] == [
        1000.0,
        1001.0,
        1002.0,
    ]


def test_horizons_that_a_seed_lacks_are_left_out(root: Path) -> None:
    path = root / "ground/astra/seed_1/gap.json"
    only = {"mean": [0.2], "low": [0.1], "high": [0.3]}
    edit_json(path, horizons=[10], grounded={"position_m": only}, raw={"position_m": only})
    make(root)
    results = Results.model_validate_json((root / "report" / "results.json").read_text())
    gap = results.gaps()["astra"]
    assert gap.horizons == [10]
    assert gap.grounded["position_m"].mean == pytest.approx([(0.2 + 0.2 + 0.6) / 3])


def test_wall_time_is_summed_over_what_recorded_it(values: Any) -> None:  # noqa: ANN401 - JSON
    assert values["wall_seconds"] == {"collect": 15.0, "ground": 21.0, "evaluate": 120.0, "total": 156.0}


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


def test_each_origin_is_told_with_its_stages(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert "| collect | 15 s | 4 k target steps/s |" in page
    assert "| ground | 21 s | 100 windows/s |" in page
    assert "| train | - | 96 k simulator steps/s; 48 k PPO steps/s |" in page
    assert "| evaluate | 2 min | 1 k target steps/s |" in page
    assert "| pair |" not in page  # neither time nor speed recorded


def test_astra_is_compared_with_rows_that_are_trained_alike(root: Path) -> None:
    """Which of ASTRA's rows did better in the test must not decide which one is compared."""
    for seed in SEEDS:
        for made in ("evaluate", "train"):
            folder = root / made / "direct_transfer"
            shutil.copytree(folder / f"seed_{seed}", root / made / f"direct_transfer_plus/seed_{seed}")
    make(root, recipe=FakeRecipe(methods=(*ROWS, "direct_transfer_plus")))
    values = json.loads((root / "report" / "results.json").read_text())
    probabilities = {
        ours: {other: found["probability"] for other, found in over.items()}
        for ours, over in values["probability_of_improvement"].items()
    }
    # ASTRA's worst seed ties with direct transfer's best: half a pair in nine.
    assert probabilities == {
        "astra": {"direct_transfer": pytest.approx(8 / 9)},
        "astra_plus": {"direct_transfer_plus": 1.0},
    }
    page = (root / "report" / "results.md").read_text()
    assert "| ASTRA | Direct transfer | 0.89 [" in page
    assert "| ASTRA+ | Direct transfer+ | 1.00 [" in page


def test_page_holds_the_table_and_only_figures_that_exist(folder: Path) -> None:
    page = (folder / "results.md").read_text()
    assert "| Direct transfer (floor) | 0.17 ± 0.14 |" in page
    assert "| ASTRA+ | **0.92 ± 0.14** |" in page
    assert "| Careful follower (ceiling) | 1.00 ± 0.00 | 1.00 [1.00, 1.00] |" in page
    assert "| No grounding | 1 [0.5, 2] | 2 [1, nan] |" in page
    assert "astra-data run recipes/antmaze_u.toml" in page
    assert "[plus]" in page
    images = {path.name for path in folder.glob("*.png")}
    assert images == {"success.png", "trajectories.png", "mismatch.png", "learning.png", "gap.png"}
    assert {image for image in images if f"]({image})" in page} == images


def test_publishing_copies_all_under_the_recipes_name(root: Path, tmp_path: Path) -> None:
    published = tmp_path / "results"
    make(root, published)
    figures = {f"antmaze_u_{name}.png" for name in ("success", "trajectories", "mismatch", "learning", "gap")}
    assert {path.name for path in published.iterdir()} == figures | {"antmaze_u.json", "antmaze_u.md"}
    assert "](antmaze_u_mismatch.png)" in (published / "antmaze_u.md").read_text()


def test_one_seed_of_rows_without_training_is_enough(root: Path) -> None:
    make(root, recipe=FakeRecipe(methods=("follower",), seeds=(1,)))
    values = json.loads((root / "report" / "results.json").read_text())
    alone = {"mean": 1.0, "std": None, "iqm": 1.0, "low": None, "high": None}
    assert values["methods"]["follower"]["summary"]["success"] == alone
    assert values["probability_of_improvement"] == {}
    assert (
        "| Careful follower (ceiling) | 1.00 | 1.00 | 0.00 |" in (root / "report" / "results.md").read_text()
    )


def test_missing_evaluations_are_all_named_with_the_command_for_the_first(root: Path) -> None:
    (root / "evaluate/astra/seed_1/evaluation.json").unlink()
    (root / "evaluate/follower/seed_2/evaluation.json").unlink()
    with pytest.raises(MissingStageError) as error:
        make(root)
    message = str(error.value)
    assert "astra seed 1, follower seed 2" in message
    assert "astra-data evaluate recipes/antmaze_u.toml --method astra --seed 1" in message
    assert not (root / "report").exists()


def test_a_grounding_of_some_seeds_only_is_missing(root: Path) -> None:
    (root / "ground/astra/seed_2/gap.json").unlink()
    with pytest.raises(MissingStageError, match=r"astra-data ground .* --method astra --seed 2"):
        make(root)


def test_rows_must_be_evaluated_alike(root: Path) -> None:
    edit_json(root / "evaluate/astra/seed_1/evaluation.json", task="antmaze-long")
    with pytest.raises(BadInputError, match="astra seed 1 on antmaze-long"):
        make(root)


def test_a_malformed_artefact_is_named_with_every_fault(root: Path) -> None:
    path = root / "evaluate/astra/seed_1/evaluation.json"
    edit_json(path, episodes=5, wall_seconds="long", seed=None)
    with pytest.raises(BadInputError, match=r"evaluation.json is not .*wall_seconds: .*seed: "):
        make(root)
    edit_json(path, wall_seconds=1.0, seed=1)
    with pytest.raises(BadInputError, match=r"expected 5 episodes, but target.success has 4"):
        make(root)


def test_a_cut_off_trajectory_file_is_refused(root: Path) -> None:
    path = root / "evaluate/astra/seed_0/trajectories.safetensors"
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(BadInputError, match="no whole safetensors file"):
        make(root)


def test_sizes_are_set_side_by_side(tmp_path: Path) -> None:
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
