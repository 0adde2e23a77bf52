from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.core.errors import BadInputError

pytestmark = pytest.mark.usefixtures("fake_recipe")


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "r.toml"
    path.write_text('task = "maze"\nmethods = ["nas"]\nseeds = [0, 1]\n[sweep]\npercent = [50, 150]\n')
    return path


def asked_of(recipe: Path, monkeypatch: pytest.MonkeyPatch, *options: str) -> dict[str, Any]:
    asked: list[dict[str, Any]] = []

    def sweep(path: Path, **given: object) -> Path:
        asked.append(given)
        folder = path.parent / "r"
        folder.mkdir()
        (folder / "sweep.csv").touch()
        return folder

    monkeypatch.setattr("astra_data.pipeline.sweep.sweep", sweep)
    result = CliRunner().invoke(cli.app, ["sweep", str(recipe), *options])
    folder = recipe.parent / "r"
    assert result.output == f"finished: {folder}\n{folder / 'sweep.csv'}\n"
    return asked[0]


def test_all_is_made_by_processes_here_unless_told_otherwise(
    recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert asked_of(recipe, monkeypatch) == {
        **{"methods": (), "seeds": (), "percents": (), "root": Path("runs")},
        **{"jobs": None, "device": "cpu", "cluster": None, "trackio": None, "until": None},
    }


def test_options_choose_points_and_where_they_are_made(recipe: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = ["--method", "nas", "--seed", "1", "--seed", "0", "--percent", "50"]
    others = ["--jobs", "3", "--device", "cuda", "--root", "elsewhere", "--trackio", "ants"]
    others += ["--until", "ground"]
    assert asked_of(recipe, monkeypatch, *points, *others) == {
        **{"methods": ["nas"], "seeds": [1, 0], "percents": [50]},
        **{
            "root": Path("elsewhere"),
            "jobs": 3,
            "device": "cuda",
            "cluster": None,
            "trackio": "ants",
            "until": "ground",
        },
    }


@pytest.mark.parametrize(("options", "cluster"), [([], "local"), (["--address", "head:6379"], "head:6379")])
def test_ray_runs_here_or_at_an_address(
    recipe: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], cluster: str
) -> None:
    assert asked_of(recipe, monkeypatch, "--engine", "ray", *options)["cluster"] == cluster


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--percent", "75"], "the recipe has no size 75; its sizes: 50, 150"),
        (["--method", "nass"], "the recipe has no method 'nass': did you mean 'nas'?"),
        (["--address", "head:6379"], "sweep: --address is for --engine ray"),
        (["--engine", "ray", "--device", "cuda:1"], "expected device cpu or cuda on a cluster, got 'cuda:1'"),
    ],
)
def test_bad_options(recipe: Path, tmp_path: Path, options: list[str], message: str) -> None:
    result = CliRunner().invoke(cli.app, ["sweep", str(recipe), "--root", str(tmp_path), *options])
    assert isinstance(result.exception, BadInputError)
    assert str(result.exception) == message
