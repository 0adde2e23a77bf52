import runpy
import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_dataset import DESCRIPTION, write_fake
from on_meta import places
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, GOAL, STATE, TERMINATED, Column, Episode
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter
from astra_data.pipeline.new_robot import write_robot
from astra_data.robots.registry import task_named
from astra_data.worlds.walk_through import check_task


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)


def command(line: str) -> str:
    shown = CliRunner().invoke(app, shlex.split(line))
    assert shown.exit_code == 0, shown.output
    return shown.output


def drives(folder: Path, count: int = 8) -> Path:
    """Write logs of carts that tip over in every second drive, and that drive to a place of their own."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(count):
        v, w = np.repeat(rng.uniform([0, -1], [1, 1], (10, 2)), 5, axis=0).T
        yaw = np.cumsum(0.1 * w) + 3.0 + 0.4 * (number % 2)
        x, y = np.cumsum(0.1 * v * np.cos(yaw)), np.cumsum(0.1 * v * np.sin(yaw))
        folded = (np.arange(50) == 49) * (number % 2)
        goal = np.ones((50, 2)) * [number, -1.0]
        rows = np.column_stack([np.arange(50) / 10, x, y, np.arctan2(np.sin(yaw), np.cos(yaw)), v, w, goal, folded])
        header = "t,x,y,heading,cmd_v,cmd_w,goal_x,goal_y,folded"
        np.savetxt(folder / f"drive_{number}.csv", rows, "%.5f", ",", header=header, comments="")
    return folder


def test_a_new_robot_runs_by_the_words_of_its_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = command(f"new my_cart --from {drives(tmp_path / 'logs')}")
    assert "a unicycle: x, y, heading, moved by v, w" in shown and "finished: my_cart" in shown
    monkeypatch.chdir("my_cart")
    block = Path("README.md").read_text().partition("```sh\n")[2].partition("```")[0]
    lines = [line.partition("  #")[0] for line in block.splitlines()]
    for line in lines[:2]:
        command(line.removeprefix("astra-data "))
    assert lines[2] == "python -m pytest"
    tests = runpy.run_path("test_my_cart.py")
    for name in (name for name in tests if name.startswith("test_")):
        tests[name]()
    command(lines[3].removeprefix("astra-data "))
    assert "--row astra_plus" in lines[6] and places(task_named("my_cart.py:TASK")) == {"meta"}


def test_a_recipe_names_task_data_methods_and_seeds_alone(tmp_path: Path) -> None:
    write_robot("cart", Path("cart"), [drives(tmp_path / "logs")])
    recipe = Path("cart/cart.toml").read_text()
    assert len(recipe.splitlines()) <= 12
    assert tomllib.loads(recipe) == {
        "task": "cart.py:TASK",
        "data": "cart-logs@data-1.0.0",
        "methods": ["astra_plus", "astra", "nas", "direct_transfer"],
        "seeds": [0, 1, 2],
        "select": {},
    }


def test_a_flag_that_ends_logs_and_goals_are_imported(tmp_path: Path) -> None:
    logs = drives(tmp_path / "logs")
    write_robot("cart", Path("cart"), sorted(logs.iterdir()))
    assert f"astra-data import {logs} --mapping logs.toml  #" in Path("cart/README.md").read_text()
    mapping = Path("cart/logs.toml").read_text()
    reason = "# CHECK: folded is 0 or 1, and it ends all 4 of 8 episodes that have a 1: a failure? If a success"
    assert f'{reason}, write next.success; if neither, delete this\n[columns."next.terminated"]' in mapping
    command(f"import {logs} --mapping cart/logs.toml --out imported")
    data = Dataset.open("imported")
    assert ("position", slice(0, 2)) in data.specs([STATE])[0].roles  # a map can be drawn
    assert data.specs(["time"])[0].units == ["s"] and "no time column" not in command("inspect imported")
    assert sum(bool(episode.columns[TERMINATED].any()) for episode in data.episodes([TERMINATED])) == 4
    objective = task_named("cart/cart.py:TASK").objective
    assert objective.goal_size == 2 and (objective.success_reward, objective.failure_reward) == (10.0, -10.0)
    drawn = objective.draw_goals(np.random.default_rng(0), 99)
    assert 0 <= drawn[:, 0].min() < 1 < 6 < drawn[:, 0].max() <= 7 and (drawn[:, 1] == -1).all()
    there, elsewhere = torch.tensor([[5.0, -1.0, 1.0, 0.0]]), torch.tensor([[5.0, -1.0]])
    assert objective.reached(there, elsewhere) and not objective.reached(there, elsewhere + 9)


def test_a_policy_sees_all_that_commands_move(tmp_path: Path) -> None:
    """A height beside a position and a heading."""
    forward, turn, up = np.sin(np.arange(3)[:, None] + np.arange(200) / 7)
    yaw = 0.1 * np.cumsum(turn)
    x, y, z = (0.1 * np.cumsum(speed) for speed in (forward * np.cos(yaw), forward * np.sin(yaw), up))
    rows = np.stack([np.arange(200) / 10, x, y, z, yaw, forward, turn, up], axis=1)
    np.savetxt("log.csv", rows, "%.6f", ",", header="t,x,y,z,yaw,cmd_v,cmd_w,cmd_vz", comments="")
    write_robot("drone", Path("drone"), [Path("log.csv")])
    task = task_named("drone/drone.py:TASK")
    high, low = (torch.tensor([[1.0, 2.0, 0.6, 0.8, height]]) for height in (3.0, 0.1))
    seen = [task.objective.observe(state, torch.zeros(1, 0)) for state in (high, low)]
    assert seen[0].shape == (1, 3) and torch.equal(seen[0][:, :2], seen[1][:, :2])
    assert [float(one[0, 2]) for one in seen] == pytest.approx([3.0, 0.1])


def test_starts_of_a_heading_are_where_it_was(tmp_path: Path) -> None:
    """It begins from 3 to 3.4 rad, on both sides of where angles wrap."""
    write_robot("cart", Path("cart"), [drives(tmp_path / "logs")])
    starts = task_named("cart/cart.py:TASK").objective.draw_starts(np.random.default_rng(0), 200)
    yaw = np.arctan2(starts[:, 3], starts[:, 2]) % (2 * np.pi)
    assert 2.8 < yaw.min() < 3.1 and 3.3 < yaw.max() < 3.6


@pytest.mark.parametrize("failed", [(), (1,), (1, 2), (0, 1, 2)])
def test_the_goal_is_where_the_usual_log_ends_that_does_not_fail(failed: tuple[int, ...], tmp_path: Path) -> None:
    ends = np.array([10.0, 30.0, 20.0])
    for number, end in enumerate(ends):
        ramp = np.linspace(0, end, 20)
        rows = np.column_stack([ramp, np.arange(20) % 3, (np.arange(20) == 19) * (number in failed)])
        np.savetxt(f"{number}.csv", rows, "%.5f", ",", header="a,cmd_a,failed", comments="")
    write_robot("slide", Path("slide"), [Path(f"{number}.csv") for number in range(3)])
    module = runpy.run_path("slide/slide.py")
    kept = np.sort([end for number, end in enumerate(ends) if number not in failed] or ends)
    assert module["GOAL"] == (kept[len(kept) // 2],) and module["RANGE"] == (30.0,)


@pytest.mark.parametrize("name", ["Cart", "2d", "my-cart", "class", "random", "torch", "logs", "rich"])
def test_a_name_is_one_of_a_file_and_a_task(name: str, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="expected a name"):
        write_robot(name, Path("out"), [drives(tmp_path / "logs", 1)])
    assert not Path("out").exists()


def test_what_cannot_be_begun_with_is_refused(tmp_path: Path) -> None:
    for version in ("1.0.0", "1.1.0"):
        write_fake(tmp_path / f"home/walks/data-{version}")
    drives(tmp_path / "logs", 1)
    (tmp_path / "bags").mkdir()
    (tmp_path / "bags/drive.mcap").touch()
    (tmp_path / "drive.csv.gz").touch()
    for given, expected in {
        "walks home/walks/data-1.1.0": "expected .* `astra-data merge`",
        "logs walks": "logs and walks: expected logs, or one dataset",
        "home/walks": "walks contains versions of a dataset: name one of data-1.0.0, data-1.1.0",
        "walks@data-3.0.0": "walks has no version data-3.0.0 in .*home; it has data-1.0.0, data-1.1.0",
        "walsk": "walsk: no such file, folder or dataset: did you mean 'walks'",
        "bags": "bags: expected files that end in .csv or .tsv, or a dataset: make one",
        "drive.csv.gz": r"drive.csv.gz is compressed: unpack it \(gunzip.*; expected files that end in .csv",
    }.items():
        with pytest.raises(BadInputError, match=expected):
            write_robot("cart", Path("cart"), [Path(place) for place in given.split()])
    shown = CliRunner().invoke(app, ["new", "cart"])
    assert isinstance(shown.exception, BadInputError) and "--from LOGS" in str(shown.exception)
    Path("other").mkdir()
    with pytest.raises(BadInputError, match="other exists already"):
        write_robot("other", Path("other"), [Path("logs")])
    assert not Path("cart").exists()


def test_a_dataset_is_taken_as_it_is(tmp_path: Path) -> None:
    """One whose names have dots and quotes, with a quaternion, goals of another size and a still command."""
    names = ("/odom:robot's x", "/odom:robot's y", "Orientation.z", "Orientation.w")
    state = Column(STATE, size=4, names=names)
    action = Column(ACTION, size=3, names=('"linear".x', "wz", "/arm:data"))
    columns = (state, action, Column(GOAL, size=3))
    v, w = np.random.default_rng(0).uniform([0, -1], [1, 1], (40, 2)).T
    yaw = np.cumsum(0.1 * w) - 0.1 * w
    way = (np.cumsum(0.1 * v * turned(yaw)) - 0.1 * v * turned(yaw) for turned in (np.cos, np.sin))
    states = np.column_stack([*way, np.sin(yaw / 2), np.cos(yaw / 2)])
    given = np.column_stack([v, w, np.full(40, 0.5)])
    with DatasetWriter(
        tmp_path / "home/base/data-1.0.0", columns=columns, fps=10, task="drive", description=DESCRIPTION
    ) as out:
        for uid in range(2):
            table = {STATE: states, ACTION: given, GOAL: np.full((40, 3), uid)}
            out.add(Episode(uid, {name: values.astype(np.float32) for name, values in table.items()}))
    shown = command("new robot --from base")
    assert "data is not in all rows" not in shown
    assert "/arm:data is 0.5 in all rows: no simulator can learn what it does (CHECK)" in shown
    task = task_named("robot/robot.py:TASK")
    assert check_task(task) == [] and task.objective.goal_size == 3
    assert task.state.names == names and list(task.limits) == list(action.names or ())
    simulator = task.make_simulator(39)
    simulator.reset_to(task.abstraction(torch.from_numpy(states[:-1])))
    landed = simulator.step(torch.from_numpy(given[:-1]))
    np.testing.assert_allclose(landed, task.abstraction(states[1:]), atol=1e-6)
    assert not Path("robot/logs.toml").exists() and "logs.toml" not in Path("robot/README.md").read_text()
    recipe = tomllib.loads(Path("robot/robot.toml").read_text())
    assert recipe["data"] == str(tmp_path / "home/base/data-1.0.0")


@pytest.mark.parametrize(
    ("names", "units", "values", "expected"),
    [
        (("x", "y", "heading"), ["m", "m", "deg"], 1.0, "state heading in deg: expected rad and rad/s"),
        (("x", "y", "heading"), None, 90.0, "heading in 1: expected rad and rad/s"),
    ],
)
def test_a_dataset_in_degrees_is_refused(
    names: tuple[str, ...], units: list[str] | None, values: float, expected: str, tmp_path: Path
) -> None:
    meaning = {"unit": units} if units else None
    columns = (Column(STATE, size=3, names=names, astra=meaning), Column(ACTION, size=2))
    with DatasetWriter(tmp_path / "set", columns=columns, fps=10, task="drive", description=DESCRIPTION) as out:
        rows = np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)
        rows[:, 2] = values
        out.add(Episode(0, {STATE: rows[:, :3], ACTION: rows[:, 3:]}))
    with pytest.raises(BadInputError, match=expected):
        write_robot("cart", Path("cart"), [tmp_path / "set"])
