import csv
import sys
from pathlib import Path
from shutil import rmtree
from types import SimpleNamespace
from typing import Any

import pytest
from fake_runs import bare_results

from astra_data.core.errors import BadInputError, MissingStageError, RecipeError
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.points import Selection
from astra_data.pipeline.sweep import sweep
from astra_data.reports.results import results_json

pytestmark = pytest.mark.usefixtures("fake_recipe")


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "r.toml"
    path.write_text(
        'task = "maze"\nmethods = ["nas", "astra", "follower"]\nseeds = [0, 1]\n'
        "[collect]\nepisodes = 20\n[sweep]\npercent = [50, 150]\n"
    )
    return path


def lines(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


def attempts(folder: Path) -> dict[str, str]:
    return {str(path.parent.relative_to(folder)): path.read_text() for path in folder.rglob("attempts")}


def test_a_sweep_goes_on_point_by_point_and_makes_shared_artifacts_once(
    recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = sweep(recipe, methods=["nas"], seeds=[1], percents=[50], root=tmp_path, jobs=1)
    assert lines(folder) == [
        {
            "method": "nas",
            "percent": "50",
            "seed": "1",
            "success": "1.0",
            "steps": "20.0",
            "return": "2.5",
            "failed": "0.5",
            "simulated_success": "0.5",
            "dataset_version": "fake@data-1.0.0",
            "dataset_hash": "hash1",
            "commit": "abc",
            "wall_seconds": "24.5",
        }
    ]
    told = capsys.readouterr().out
    assert "evaluate/nas/percent_050/seed_1  done 1.00  (1 of 1 points)" in told

    # A point whose artifacts are removed is not finished any more; the table says what is there.
    sweep(recipe, root=tmp_path, jobs=2)
    made = attempts(folder)
    assert set(made.values()) == {"."}
    assert sum(key.startswith("pair") for key in made) == 2
    assert sum(key.startswith("subset") for key in made) == 4
    assert [tuple(line[key] for key in ("method", "percent", "seed")) for line in lines(folder)] == [
        (method, percent, seed)
        for method in ("nas", "astra", "follower")
        for percent in ("50", "150")
        for seed in ("0", "1")
    ]
    assert {line["simulated_success"] for line in lines(folder) if line["method"] == "follower"} == {""}
    assert {line["wall_seconds"] for line in lines(folder) if line["method"] == "astra"} == {"24.75"}


def test_what_the_base_makes_is_not_made_here(recipe: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text('based_on = "r"\n[evaluate]\nsteps = 3\n')
    with pytest.raises(MissingStageError, match="r/train/nas/percent_050/seed_1 is missing"):
        sweep(other, methods=["nas"], seeds=[1], percents=[50], root=tmp_path, jobs=1)


def test_without_sizes_a_point_has_all_of_the_data(
    recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe.write_text(recipe.read_text().replace("percent = [50, 150]", ""))
    folder = sweep(recipe, methods=["follower"], seeds=[1], root=tmp_path, jobs=1)
    assert [(line["method"], line["percent"]) for line in lines(folder)] == [("follower", "100")]
    assert "evaluate/follower/seed_1  finished in" in capsys.readouterr().out


def test_networks_compute_on_the_device_that_is_asked_for(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: set[tuple[str, str]] = set()
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setattr(
        "astra_data.pipeline.run.execute",
        lambda items, **_: told.update((item.key.partition("/")[0], item.device) for item in items),
    )
    sweep(recipe, methods=["nas"], root=tmp_path, device="cuda:0", until="train")
    assert ("train", "cuda:0") in told and ("collect", "cpu") in told


def test_a_stage_that_is_none_is_told_before_anything_is_opened(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="unknown stage 'grund'"):
        sweep(tmp_path / "absent.toml", root=tmp_path, until="grund")


def test_points_outlive_what_they_were_made_of(recipe: Path, tmp_path: Path) -> None:
    folder = sweep(recipe, methods=["nas"], seeds=[1], percents=[50], root=tmp_path, jobs=1)
    rmtree(folder / "train")
    sweep(recipe, methods=["follower"], seeds=[1], percents=[50], root=tmp_path, jobs=1)
    times = {line["method"]: line["wall_seconds"] for line in lines(folder)}
    assert times["nas"] == ""
    assert float(times["follower"]) > 0


def publish(recipe: Path, rows: dict[str, list[int]]) -> Path:
    """Write results of some seeds of rows; return their file."""
    settings = load_experiment(recipe, recipe.parent).recipe.settings
    path = recipe.parent / "results" / "r.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(results_json(bare_results("r", rows, settings)))
    return path


@pytest.mark.parametrize(
    ("row", "table", "counts"),
    [
        ("nas", "[report]\nsteps = {}\n", False),
        ("nas", "[train]\nsteps = {}\n", True),
        ("nas", "[target]\nnum_envs = {}\n", False),
        ("full_obs", "[target]\nnum_envs = {}\n", True),
    ],
)
def test_settings_of_published_rows_may_not_change(
    recipe: Path, tmp_path: Path, row: str, table: str, counts: bool
) -> None:
    assert load_experiment(recipe, tmp_path).published() == []
    text = recipe.read_text().replace('"astra"', '"astra", "full_obs"')
    recipe.write_text(text + table.format(7))
    file = publish(recipe, {row: [0]})
    recipe.write_text(text + table.format(8))
    if not counts:
        assert load_experiment(recipe, tmp_path).published() == [file]
        return
    with pytest.raises(RecipeError, match=r"^\w+ changed in .*r.toml since the results in .*r.json"):
        load_experiment(recipe, tmp_path).published()


def test_a_failed_sweep_keeps_the_points_that_are_finished(recipe: Path, tmp_path: Path) -> None:
    recipe.write_text(recipe.read_text() + "[train]\nfails = true\n")
    sweep(recipe, methods=["follower"], root=tmp_path, jobs=1)
    with pytest.raises(BadInputError, match=r"^train/nas/percent_050/seed_0: told to fail$"):
        sweep(recipe, methods=["nas"], seeds=[0], percents=[50], root=tmp_path, jobs=1)
    assert len(lines(tmp_path / "r")) == 4


def test_sizes_may_be_added_below_the_largest(recipe: Path, tmp_path: Path) -> None:
    sweep(recipe, methods=["follower"], seeds=[0], percents=[150], root=tmp_path, jobs=1)
    recipe.write_text(recipe.read_text().replace("[50, 150]", "[25, 150]"))
    sweep(recipe, methods=["follower"], seeds=[0], percents=[25], root=tmp_path, jobs=1)
    assert [line["percent"] for line in lines(tmp_path / "r")] == ["25", "150"]
    recipe.write_text(recipe.read_text().replace("[25, 150]", "[25, 200]"))
    with pytest.raises(RecipeError, match=r"^sweep \(150, now 200\) changed in the recipe since .*/collect"):
        sweep(recipe, root=tmp_path)


def test_finished_points_are_logged(recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []
    trackio = SimpleNamespace(
        init=lambda **settings: told.append(settings), log=told.append, finish=lambda: told.append("finished")
    )
    part: dict[str, Any] = {"methods": ["follower"], "seeds": [1], "percents": [50], "root": tmp_path}
    monkeypatch.setitem(sys.modules, "trackio", None)
    with pytest.raises(BadInputError, match="uv sync --extra trackio"):
        sweep(recipe, **part, trackio="ants")
    assert not (tmp_path / "r").exists()
    monkeypatch.setitem(sys.modules, "trackio", trackio)
    for _ in range(2):
        sweep(recipe, **part, trackio="ants")
    began, logged, ended = told
    assert (began["project"], began["name"], ended) == ("ants", "r follower 50 1", "finished")
    assert began["config"]["dataset_hash"] == "hash1"
    assert logged["success"] == 1.0


@pytest.mark.parametrize(("until", "made", "pages"), [("subset", "subset", 0), ("ground", "ground", 1)])
def test_a_sweep_ends_after_the_stage_that_is_named(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, until: str, made: str, pages: int
) -> None:
    told: list[tuple[object, ...]] = []
    monkeypatch.setattr("astra_data.pipeline.sweep.write_errors", lambda *given: told.append(given))
    folder = sweep(recipe, methods=["nas"], seeds=[1], percents=[50], root=tmp_path, jobs=1, until=until)
    stages = {path.name for path in folder.iterdir() if path.is_dir()}
    assert made in stages and not stages & {"train", "evaluate", "report"}
    assert ("ground" in stages) == (until == "ground")
    assert [given[1] for given in told] == [Selection(("nas",), (1,), (50,))] * pages


def test_a_whole_sweep_writes_the_page_of_held_out_errors(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Selection] = []
    monkeypatch.setattr("astra_data.pipeline.sweep.write_errors", lambda _, part: told.append(part))
    sweep(recipe, methods=["nas"], seeds=[1], percents=[50], root=tmp_path, jobs=1)
    assert told == [Selection(("nas",), (1,), (50,))]


def test_points_are_made_where_and_how_it_is_asked_for(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[dict[str, Any]] = []
    monkeypatch.setattr("astra_data.pipeline.sweep.make", lambda *_, **how: told.append(how))
    how: dict[str, Any] = {"jobs": 3, "device": "cuda:0", "cluster": "local"}
    sweep(recipe, root=tmp_path, until="pair", **how)
    assert how.items() <= told[0].items()
