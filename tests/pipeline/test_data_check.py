import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import write_fake
from fake_stages import FakeStages
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE, Column, Episode
from astra_data.pipeline.executors import EXECUTORS
from astra_data.pipeline.run import check, run
from astra_data.pipeline.stages.pair import pair

ROOT = Path(__file__).parents[2]


def write_logs(
    folder: Path,
    least: float,
    largest: float,
    *,
    state_size: int = 2,
    held_out: Sequence[bool] = (False,) * 2,
    ahead: float = 0.0,
    **metadata: int,
) -> None:
    """Write pushes of the small cart, whose bounds are -1 and 4; `metadata` is of each.

    Next states are `ahead` of the states of the rows after them.
    """
    names = ("x", "speed", *"abcd")[:state_size]
    columns = [Column(name, size=state_size, names=names) for name in (STATE, NEXT_STATE)]
    columns += [Column(ACTION, size=1, names=("v",))]
    states = np.zeros((9, state_size), np.float32)
    actions = np.linspace(least, largest, 9, dtype=np.float32)
    values = {STATE: states, NEXT_STATE: states + np.float32(ahead), ACTION: actions}
    episodes = (Episode(uid, values, {"held_out": held, **metadata}) for uid, held in enumerate(held_out))
    write_fake(folder, episodes, columns=columns, fps=10)


@pytest.fixture
def recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setitem(EXECUTORS, "processes", FakeStages().run_here)
    shutil.copy(ROOT / "tests/small_cart.py", tmp_path / "rail.py")
    path = tmp_path / "rail.toml"
    path.write_text('task = "rail.py:TASK"\ndata = "logs"\nmethods = ["nas"]\nseeds = [0]\n')
    return path


@pytest.mark.parametrize(
    ("least", "largest", "expected"),
    [
        (-0.9, 3.9, ""),  # within 5 % of what was recorded
        (-0.75, 4.0, "v may be -1 to 4, recorded is -0.75 to 4"),  # just beyond these 5 %
        (-0.5, 4.0, "v may be -1 to 4, recorded is -0.5 to 4: narrow the bounds of the commands, or rec"),
        (-1.0, 3.0, "v may be -1 to 4, recorded is -1 to 3"),
        (-40.0, 59.0, ""),
        (-250.0, 900.0, "v may be -1 to 4, recorded is -250 to 900: are both in the same unit?"),
    ],
)
def test_bounds_beyond_what_was_recorded_are_told(recipe: Path, least: float, largest: float, expected: str) -> None:
    write_logs(recipe.parent / "logs", least, largest)
    shown = CliRunner().invoke(app, ["check", str(recipe), "--root", str(recipe.parent / "runs")]).output
    data, *warnings = shown.splitlines()[1 : 4 if expected else 3]
    assert data == "  finished  data"
    goals = "  warning   data: fake@data-1.0.0 has no observation.environment_state: goals are dr"
    assert warnings[-1].startswith(goals) and len(warnings) == 1 + bool(expected)
    assert all(line.startswith(f"  warning   data: {expected}") for line in warnings[:-1])


def test_steps_that_do_not_lead_to_the_row_after_them_are_told(
    recipe: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_logs(recipe.parent / "logs", -1.0, 4.0, ahead=0.5)
    found = check(recipe, root=recipe.parent / "runs")["data"]
    what = f"steps whose {NEXT_STATE} is not the state of the next row: 16 of 16: rows are missing"
    assert found.state == "finished" and found.warnings[0].startswith(what)
    run(recipe, root=recipe.parent / "runs", until="label")
    assert f"warning: data: {found.warnings[0]}\n" in capsys.readouterr().out


def test_data_that_are_not_there_are_asked_for(recipe: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(recipe.parent / "home"))
    with pytest.raises(BadInputError, match=r"data: no dataset 'logs' in .*: import or pull it first"):
        check(recipe, root=recipe.parent / "runs")
    with pytest.raises(BadInputError, match=r"data: no dataset 'logs' in .*: import or pull it first"):
        run(recipe, root=recipe.parent / "runs")
    assert not (recipe.parent / "runs").exists()


def test_data_are_not_asked_for_once_they_are_labeled(recipe: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, runs = recipe.parent / "home", recipe.parent / "runs"
    monkeypatch.setenv("ASTRA_DATA_HOME", str(home))
    write_logs(home / "logs/data-1.0.0", -1.0, 4.0)
    run(recipe, root=runs, until="label")
    shutil.rmtree(home)
    run(recipe, root=runs, until="pair")
    assert (runs / "rail/pair/seed_0").is_dir()


def test_data_that_were_paired_are_refused(recipe: Path) -> None:
    write_logs(recipe.parent / "first", -1.0, 4.0)
    pair(f"{recipe.parent}/rail.py:TASK", dataset=recipe.parent / "first", out=recipe.parent / "logs")
    with pytest.raises(BadInputError, match=r"data: fake@.* is paired already, but a recipe pairs its data itself"):
        check(recipe, root=recipe.parent / "runs")


def test_data_of_which_none_is_left_to_train_on_are_refused(recipe: Path) -> None:
    write_logs(recipe.parent / "logs", -1.0, 4.0, held_out=[False])
    told = r"fake@data-1.0.0: recorded episodes: 1, of which 1 would be held out, and none is left"
    with pytest.raises(BadInputError, match=told):
        check(recipe, root=recipe.parent / "runs")
    recipe.write_text(recipe.read_text().replace("nas", "direct_transfer"))
    assert check(recipe, root=recipe.parent / "runs")["data"].state == "finished"


@pytest.mark.parametrize(
    ("percent", "copies", "told"),
    [
        ("[50, 100]", {}, ""),
        ("[100, 25]", {}, "25 % of fake@data-1.0.0: recorded episodes: 1, of which 1 would be held out"),
        ("[10, 50]", {}, "10 % of fake@data-1.0.0: recorded episodes: 0, of which 0 would be held out"),
        ("[50, 100]", {"source_episode": 0}, "50 % of fake@data-1.0.0: recorded episodes: 1, of which 1"),
    ],
)
def test_the_smallest_size_of_a_sweep_has_to_leave_some(
    recipe: Path, percent: str, copies: dict[str, int], told: str
) -> None:
    write_logs(recipe.parent / "logs", -1.0, 4.0, held_out=[False] * 4, **copies)
    recipe.write_text(recipe.read_text() + f"[sweep]\npercent = {percent}\n")
    if told:
        with pytest.raises(BadInputError, match=told):
            check(recipe, root=recipe.parent / "runs")
    else:
        assert check(recipe, root=recipe.parent / "runs")["data"].state == "finished"


def test_a_task_of_ones_own_is_walked_through_before_a_run(recipe: Path) -> None:
    write_logs(recipe.parent / "logs", -1.0, 4.0)
    task = recipe.parent / "rail.py"
    task.write_text(task.read_text().replace("+ ends", "+ nothing"))
    with pytest.raises(BadInputError, match=r"rail.py:TASK: objective.reward.*'nothing'.* \(rail.py, line \d+\)"):
        run(recipe, root=recipe.parent / "runs")
    assert not (recipe.parent / "runs/rail/label").exists()


def test_inputs_of_the_target_encoder_are_looked_for_before_any_fit(recipe: Path, tmp_path: Path) -> None:
    write_logs(tmp_path / "logs", -1.0, 4.0)
    recipe.write_text(recipe.read_text() + '[align]\ninputs = ["observation.features.front"]\n')
    with pytest.raises(BadInputError, match=r"has no column observation.features.front; it has observation.state"):
        run(recipe, root=tmp_path / "runs")
    recipe.write_text(recipe.read_text().replace('data = "logs"\n', "").replace("rail.py:TASK", "antmaze-umaze"))
    with pytest.raises(RecipeError, match="inputs: expected a recipe with `data`, since `collect` records states"):
        check(recipe, root=tmp_path / "runs")
