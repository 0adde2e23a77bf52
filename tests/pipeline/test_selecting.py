import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from fake_runs import edit_json
from rail_run import rail_run
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.durable import held
from astra_data.core.errors import BadInputError
from astra_data.methods import grounded_as
from astra_data.pipeline.selecting import select

pytestmark = pytest.mark.usefixtures("quick_fits")


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rail_run(tmp_path_factory, seeds=[0, 1, 2], methods=["direct_transfer", "nas"])


def test_the_command_is_a_door_to_the_stage(folder: Path) -> None:
    shown = CliRunner().invoke(app, ["select", str(folder), "--row", "nas", "--episodes", "5"])
    assert shown.exit_code == 0, shown.output
    record = json.loads((folder / "select/select.json").read_text())
    assert [one["row"] for one in record["candidates"]] == ["nas"] * 3
    assert record["judge"] == "nas" and record["episodes"] == 5
    assert "chosen: nas, seed " in shown.output and "select.md" in shown.output


def test_the_recipe_says_how_unless_the_call_does(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("astra_data.pipeline.stages.select.judged_success", lambda *_: 0.5)
    assert select(folder).episodes == 100
    edit_json(folder / "recipe.json", select={"episodes": 9})
    assert select(folder).episodes == 9 and select(folder, episodes=8).episodes == 8


def test_a_choice_that_is_there_is_kept_and_another_set_aside(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def success(task: object, judge: object, policy: object, episodes: int, seed: int) -> float:
        asked.append(seed)
        return 0.5

    monkeypatch.setattr("astra_data.pipeline.stages.select.judged_success", success)
    first = select(folder, rows=["nas"], episodes=5)
    assert select(folder, rows=["nas"], episodes=5) == first and len(asked) == 6
    select(folder, rows=["nas"], episodes=6)
    assert json.loads((folder / "set_aside/1/select/select.json").read_text())["episodes"] == 5
    assert len(select(folder, episodes=6).candidates) == 6 and len(asked) == 6 + 6 + 12
    (folder / "select/select.md").unlink()
    select(folder, episodes=6)
    assert (folder / "select/select.md").is_file() and (folder / "set_aside/3/select").is_dir()
    shutil.rmtree(folder / "train/nas/seed_2")
    assert len(select(folder, episodes=6).candidates) == 5 and (folder / "set_aside/4/select").is_dir()


def test_a_run_in_use_is_refused(folder: Path) -> None:
    with held(folder) as ours, pytest.raises(BadInputError, match="is in use by another run"):
        assert ours
        select(folder)
    assert not (folder / "select").exists()


def test_what_is_not_there_is_asked_for(folder: Path) -> None:
    with pytest.raises(BadInputError, match="nothing"):
        select(folder, rows=["nothing"])
    (folder.parent / "base").mkdir()
    (folder / "select").symlink_to(folder.parent / "base")
    with pytest.raises(BadInputError, match="which this run is based on: run select there"):
        select(folder)


def asked(folder: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]) -> Any:
    """What a run whose recipe has these `changes` asks to be judged."""
    told = list[Any]()
    edit_json(folder / "recipe.json", **changes)

    def noted(asked: Any, *_: object, **more: object) -> None:
        told.append(asked)
        raise StopIteration

    monkeypatch.setattr("astra_data.pipeline.selecting.judge_all", noted)
    with pytest.raises(StopIteration):
        select(folder)
    [one] = told
    return one


def test_policies_of_every_size_are_judged(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert asked(folder, monkeypatch, {"sweep": {"percent": [50, 100]}}).percents == (50, 100)


@pytest.mark.usefixtures("forgotten_methods")
def test_rows_are_judged_with_the_groundings_that_they_share(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ensemble = f"{Path(__file__).parents[2]}/recipes/examples/methods/gru_ensemble.py:METHOD"
    changes = {"methods": ["nas_plus", "mine"], "user_methods": {"mine": {"method": ensemble}}}
    rows = asked(folder, monkeypatch, changes).methods
    assert {row: grounded_as(row) for row in rows} == {"nas_plus": "nas", "mine": "mine"}
