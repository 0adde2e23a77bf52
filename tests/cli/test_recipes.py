from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.cli.arguments import of_recipe
from astra_data.cli.recipes import show_made
from astra_data.core.errors import AstraDataError, BadInputError

pytestmark = pytest.mark.usefixtures("stages")


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "r.toml"
    path.write_text('task = "antmaze-umaze"\nmethods = ["astra", "astra_plus"]\nseeds = [0]\n[train]\ntries = 5\n')
    return path


def test_the_command_line_checks_and_runs_a_stage(recipe: Path, tmp_path: Path) -> None:
    def call(*arguments: str) -> str:
        result = CliRunner().invoke(cli.app, [*arguments, "--root", str(tmp_path)], catch_exceptions=False)
        assert result.exit_code == 0
        return result.output

    assert "0 of 9 items are finished" in call("check", str(recipe))
    assert "collect/seed_0  finished" in call("collect", str(recipe), "--seed", "0")
    assert "  finished  collect/seed_0\n  to do     pair/seed_0\n" in call("check", str(recipe))


@pytest.mark.parametrize(
    ("until", "looked_at", "shown"),
    [
        (None, ["gap.md", "report/results.html", "sweep.csv"], ""),
        ("ground", ["gap.md"], "held-out errors\n"),
        ("pair", [], ""),
    ],
)
def test_a_run_ends_with_the_pages_to_look_at(
    tmp_path: Path, until: str | None, looked_at: list[str], shown: str, capsys: pytest.CaptureFixture[str]
) -> None:
    show_made(tmp_path, until)
    assert capsys.readouterr().out == f"finished: {tmp_path}\n"
    (tmp_path / "gap.md").write_text("held-out errors")
    (tmp_path / "report").mkdir()
    for page in ("report/results.html", "sweep.csv"):
        (tmp_path / page).touch()
    show_made(tmp_path, until)
    listed = "".join(f"{tmp_path / page}\n" for page in looked_at)
    assert capsys.readouterr().out == f"{shown}finished: {tmp_path}\n{listed}"


def test_a_run_passes_its_options_on(recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe.write_text('task = "antmaze-umaze"\nmethods = ["nas"]\nseeds = [0, 1]\n[sweep]\npercent = [50]\n')
    asked: list[dict[str, Any]] = []

    def run(_: Path, **given: Any) -> Path:
        asked.append(given)
        return tmp_path

    monkeypatch.setattr("astra_data.pipeline.run.run", run)
    words = "--method nas --seed 1 --seed 0 --percent 50 --jobs 3 --device cuda --root elsewhere"
    words += " --until ground --engine ray --address head:6379"
    assert CliRunner().invoke(cli.app, ["run", str(recipe), *words.split()]).exit_code == 0
    assert CliRunner().invoke(cli.app, ["run", str(recipe)]).exit_code == 0
    assert asked[0] == {
        **{"methods": ["nas"], "seeds": [1, 0], "percents": [50], "jobs": 3, "device": "cuda"},
        **{"root": Path("elsewhere"), "until": "ground", "engine": "ray"},
        "address": "head:6379",
    }
    assert asked[1]["engine"] == "processes" and not asked[1]["methods"]


@pytest.mark.parametrize(
    ("stage", "takes"),
    [
        ("ground", {"methods", "seeds", "jobs", "device"}),
        ("evaluate", {"methods", "seeds", "jobs"}),
        ("report", {"seeds", "publish"}),
        ("pair", {"seeds", "jobs"}),
    ],
)
def test_a_command_passes_its_options_to_its_stage(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str, takes: set[str]
) -> None:
    asked: list[Any] = []
    recipe.write_text('task = "antmaze-umaze"\nmethods = ["nas", "astra"]\nseeds = [4, 7]\n')

    def run_stage(*arguments: object, **options: object) -> Path:
        asked.append((*arguments, options))
        return tmp_path / "made"

    monkeypatch.setattr("astra_data.pipeline.run.run_stage", run_stage)
    words = {
        "methods": (["--method", "nas", "--method", "astra"], ["nas", "astra"]),
        "seeds": (["--seed", "4", "--seed", "7"], [4, 7]),
        "jobs": (["--jobs", "3"], 3),
        "device": (["--device", "cuda:1"], "cuda:1"),
        "publish": (["--publish"], True),
    }
    given = [word for name in sorted(takes) for word in words[name][0]]
    result = CliRunner().invoke(cli.app, [stage, str(recipe), "--root", str(tmp_path), *given])
    assert result.output == f"finished: {tmp_path if stage == 'report' else tmp_path / 'made'}\n"
    given_by_default = {"device": "cpu", "publish": False}
    (told,) = asked
    assert told[:2] == (recipe, stage)
    expected = {name: words[name][1] for name in takes} | {"root": tmp_path}
    assert {key: value for key, value in told[2].items() if given_by_default.get(key) != value} == expected


@pytest.mark.parametrize(
    ("words", "folder"),
    [("", "deploy/nas/seed_0"), ("--seed 1 --percent 50", "deploy/nas/percent_050/seed_1"), ("--out there", "there")],
)
def test_a_policy_is_deployed_within_its_run_unless_out_says_where(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, folder: str
) -> None:
    monkeypatch.chdir(tmp_path)
    run = Path("runs/cart")
    run.mkdir(parents=True)
    (run / "recipe.json").write_text("{}")
    monkeypatch.setattr("astra_data.deployment.folder.deploy", lambda run, row, out, **_: out)
    result = CliRunner().invoke(cli.app, ["deploy", str(run), "--row", "nas", *words.split()])
    assert result.output == f"finished: {Path(folder) if '--out' in words else run / folder}\n"


def test_faults_of_all_recipes_are_told(recipe: Path, tmp_path: Path) -> None:
    broken = [tmp_path / "a.toml", tmp_path / "b.toml"]
    for path in broken:
        path.write_text(recipe.read_text().replace("[train]", "[trainn]"))
    paths = [broken[0], recipe, broken[1]]
    result = CliRunner().invoke(cli.app, ["check", *map(str, paths), "--root", str(tmp_path)])
    assert f"{recipe}: 0 of 9 items are finished" in result.output and isinstance(result.exception, AstraDataError)
    assert [str(path) in str(result.exception) for path in paths] == [True, False, True]


@pytest.mark.parametrize("command", [["run"], ["select", "--trials", "3"]])
def test_ctrl_c_says_how_to_go_on(command: list[str], recipe: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for function in ("run.digests_of", "selecting.choose_by_trials"):
        monkeypatch.setattr(f"astra_data.pipeline.{function}", Mock(side_effect=KeyboardInterrupt))
    result = CliRunner().invoke(cli.app, [*command, str(recipe)])
    assert result.exit_code == 130 and "run the same command again" in result.output


def test_options_that_a_recipe_sets_itself_are_refused() -> None:
    own = {"of": 3, "min_steps": 0, "name": None}
    assert not of_recipe("walks", "subset", own, seeds=[1], jobs=None)
    with pytest.raises(BadInputError, match=r"\[sweep\] sets this: leave out --of, --min-steps$"):
        of_recipe("r.toml", "subset", own, table="sweep", seeds=None, jobs=2)
