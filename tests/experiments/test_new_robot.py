import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_dataset import DESCRIPTION, write_fake
from on_meta import places
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.dataset import DatasetWriter
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, STATE, Column, Episode
from astra_data.dataset.reader import Dataset
from astra_data.experiments.new_robot import write_robot
from astra_data.experiments.run import check, run
from astra_data.worlds.registry import task_named
from astra_data.worlds.walk_through import check_task


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)


def command(line: str) -> None:
    app(shlex.split(line), standalone_mode=False)


def arm(path: Path) -> Path:
    """Write a log of three joints that follow commanded rates, in degrees and microseconds, in two trials."""
    rng = np.random.default_rng(0)
    rates = np.repeat(rng.uniform(-30, 30, (8, 3)), 10, axis=0)
    joints = np.concatenate([np.zeros((1, 3)), np.cumsum(0.05 * rates, axis=0)[:-1]])
    table = np.column_stack([np.arange(80) * 50_000, np.arange(80) // 40, joints, rates])
    header = "time_us,episode,q1_deg,q2_deg,q3_deg,cmd_q1_deg_s,cmd_q2_deg_s,cmd_q3_deg_s"
    np.savetxt(path, table, "%.3f", ",", header=header, comments="")
    return path


def test_a_new_robot_runs_by_the_words_of_its_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command("new my_cart")
    monkeypatch.chdir("my_cart")
    page = Path("README.md").read_text()
    lines = [
        line.partition("  #")[0] for line in page.partition("```sh\n")[2].partition("```")[0].splitlines()
    ]
    assert [line.split()[:2] for line in lines[:2]] == [["astra-data", "import"], ["astra-data", "inspect"]]
    for line in lines[:2]:
        command(line.removeprefix("astra-data "))
    assert lines[2] == "python -m pytest"
    tested = subprocess.run(
        [sys.executable, *shlex.split(lines[2])[1:], "-q"], capture_output=True, text=True, check=False
    )
    assert "3 passed" in tested.stdout, tested.stdout
    assert lines[3:6] == [
        "astra-data check my_cart.toml",
        "astra-data run my_cart.toml --until ground",
        "astra-data run my_cart.toml",
    ]
    assert "train/astra/seed_0" in check(Path("my_cart.toml"))
    run(Path("my_cart.toml"), until="pair", jobs=1)
    assert len(Dataset.open("runs/my_cart/pair/seed_0")) == 60
    command(lines[6].removeprefix("astra-data ") + " --help")
    assert len(Path("my_cart.py").read_text().splitlines()) < 75
    assert places(task_named("my_cart.py:TASK")) == {"meta"}


def test_logs_of_an_arm_give_its_task(tmp_path: Path) -> None:
    log = arm(tmp_path / "log.csv")
    shown = CliRunner().invoke(app, ["new", "arm", "--from", str(log), "--out", "robots/arm"])
    assert shown.exit_code == 0 and "command q2" in shown.output, shown.output
    task = task_named("robots/arm/arm.py:TASK")
    assert task.timestep_s == 0.05 and task.state.names == ("q1", "q2", "q3")
    assert places(task) == {"meta"}
    least, largest = task.limits["q1"]
    assert -np.radians(30) - 1e-3 <= least < 0 < largest <= np.radians(30) + 1e-3
    split = tomllib.loads(Path("robots/arm/logs.toml").read_text())["split"]
    assert split == {"field": "episode", "gap_s": 0.25}  # five steps
    command(f"import {log} --mapping robots/arm/logs.toml --out imported")
    data = Dataset.open("imported")
    assert (len(data), len(data.columns(["action"])["action"])) == (2, 78)
    command("pair imported --simulator robots/arm/arm.py:TASK --out pairs")
    columns = Dataset.open("pairs").columns(["abstract.next_state", "abstract.simulated_next_state"])
    recorded, simulated = columns.values()
    np.testing.assert_allclose(simulated, recorded, atol=1e-4)


def test_a_rate_and_a_target_are_stepped_as_the_logs_were(tmp_path: Path) -> None:
    commands = np.random.default_rng(0).uniform([-1, -90], [1, 90], (60, 2))
    x = np.concatenate([[0], np.cumsum(0.1 * commands[:-1, 0])])
    table = np.column_stack([np.arange(60) / 10, x, np.concatenate([[0], commands[:-1, 1]]), commands])
    np.savetxt("grip.csv", table, "%.6f", ",", header="time,x,grip,cmd_vx,cmd_grip", comments="")
    write_robot("grip", Path("grip"), [Path("grip.csv")])
    runpy.run_path("grip/test_grip.py")["test_a_step_of_the_simulator"]()
    simulator = task_named("grip/grip.py:TASK").make_simulator(59)
    simulator.reset_to(torch.from_numpy(table[:-1, 1:3]).float())
    landed = simulator.step(torch.from_numpy(commands[:-1]).float())
    np.testing.assert_allclose(landed, table[1:, 1:3], atol=1e-4)
    elsewhere = runpy.run_path("grip/grip.py")["Direct"](59, device="meta")
    assert elsewhere.step(torch.empty(59, 2, device="meta")).device.type == "meta"


def test_a_heading_that_wraps_is_shown_without_jumps(tmp_path: Path) -> None:
    """A drone whose turn rate stands between its speeds, and a mast that is put where it is commanded."""
    rng = np.random.default_rng(0)
    commands = rng.uniform([-3, -1, 1, -1], [3, 1, 2, 1], (200, 4))  # it turns around some times
    ways = 3 + np.cumsum(0.1 * commands, axis=0) - 0.1 * commands
    yaw = np.arctan2(np.sin(ways[:, 2]), np.cos(ways[:, 2]))
    mast = np.concatenate([[0], commands[:-1, 0]])
    x, z = ways[:, 1], ways[:, 3]
    table = np.column_stack([np.arange(200) / 10, yaw, x, z, mast, commands])
    header = "time,yaw,x,z,mast_yaw,cmd_mast_yaw,cmd_vx,cmd_yaw_rate,cmd_vz"
    np.savetxt("log.csv", table, "%.6f", ",", header=header, comments="")
    kind = write_robot("drone", Path("drone"), [Path("log.csv")])
    assert kind.simulator.endswith("; mast_yaw as cosine and sine; yaw as cosine and sine")
    task = task_named("drone/drone.py:TASK")
    assert task.abstract_state.names == ("x", "z", "mast_yaw_x", "yaw_x", "mast_yaw_y", "yaw_y")
    assert [*task.abstract_state.units] == ["m", "m", "1", "1", "1", "1"]
    angles = np.column_stack([mast, yaw])
    expected = np.column_stack([x, z, np.cos(angles), np.sin(angles)])
    np.testing.assert_allclose(task.abstraction(table[:, 1:5]), expected, atol=1e-9)
    simulator = task.make_simulator(199)
    simulator.reset_to(task.abstraction(torch.from_numpy(table[:-1, 1:5]).float()))
    landed = simulator.step(torch.from_numpy(commands[:-1]).float())
    np.testing.assert_allclose(landed, expected[1:], atol=1e-4)
    assert np.abs(np.diff(yaw)).max() > 6  # it wraps
    starts = task.objective.draw_starts(rng, 9)
    np.testing.assert_allclose(starts[:, 2:4] ** 2 + starts[:, 4:] ** 2, 1)
    goal = torch.tensor([runpy.run_path("drone/drone.py")["GOAL"]])
    away = goal * torch.tensor([1, 1, -1, 1, -1, 1])  # by half a turn, which is the whole range
    far = task.objective.far(torch.cat([goal, away]))  # type: ignore[attr-defined]
    torch.testing.assert_close(far, torch.tensor([0.0, 1.0]), atol=0.01, rtol=0)
    assert check_task(task) == [] and places(task) == {"meta"}
    elsewhere = runpy.run_path("drone/drone.py")["Direct"](9, device="meta")
    assert elsewhere.step(torch.empty(9, 4, device="meta")).device.type == "meta"
    tests = runpy.run_path("drone/test_drone.py")
    tests["test_a_step_of_the_simulator"]()
    tests["test_phi_of_the_first_row_of_the_logs"]()
    assert len(Path("drone/drone.py").read_text().splitlines()) < 75


def test_torques_of_an_arm_give_a_task(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    columns = {f"q{joint}": rng.normal(size=60) for joint in range(1, 7)}
    columns |= {f"tau{joint}": rng.uniform(-2, 2, 60) for joint in range(1, 7)}
    header = ",".join(["time", *columns])
    np.savetxt(
        "log.csv",
        np.column_stack([np.arange(60) / 50, *columns.values()]),
        "%.4f",
        ",",
        header=header,
        comments="",
    )
    command("new arm6 --from log.csv")
    shutil.copy("log.csv", "again.csv")
    command("import log.csv again.csv --mapping arm6/logs.toml")
    assert check_task(task_named("arm6/arm6.py:TASK")) == []
    assert "data" in check(Path("arm6/arm6.toml"))


def test_a_twist_of_six_fields_is_a_unicycle(tmp_path: Path) -> None:
    rows = np.arange(60)
    turns = np.where(rows % 20 < 10, 0.5, -0.5)
    yaw = np.cumsum(0.05 * turns)
    pose = [0.05 * np.cumsum(np.cos(yaw)), 0.05 * np.cumsum(np.sin(yaw)), yaw]
    twist = [0.9 + 0.1 * (rows % 2), *np.zeros((4, 60)), turns]
    header = "header.stamp,pose.x,pose.y,pose.yaw," + ",".join(
        f"cmd_vel.{part}.{axis}" for part in ("linear", "angular") for axis in "xyz"
    )
    table = np.column_stack([rows / 20, *pose, *twist])
    np.savetxt("log.csv", table, "%.4f", ",", header=header, comments="")
    driven = "a unicycle: pose_x, pose_y, pose_yaw, driven by vel_linear_x, vel_angular_z"
    shown = CliRunner().invoke(app, ["new", "rover", "--from", "log.csv"])
    assert f"abstract simulator: {driven}\n" in shown.output
    assert driven in Path("rover/README.md").read_text()
    shutil.copy("log.csv", "again.csv")
    command("import log.csv again.csv --mapping rover/logs.toml")
    assert "class Unicycle" in Path("rover/rover.py").read_text()
    task = task_named("rover/rover.py:TASK")
    assert check_task(task) == [] and task.timestep_s == 0.05
    assert list(task.limits) == ["vel_linear_x", "vel_angular_z"]
    assert "data" in check(Path("rover/rover.toml"))


def test_the_page_s_commands_take_folders_with_spaces(tmp_path: Path) -> None:
    logs = tmp_path / "my logs"
    logs.mkdir()
    write_robot("first", tmp_path / "first")
    shutil.copytree(tmp_path / "first/logs", logs, dirs_exist_ok=True)
    write_robot("rover", tmp_path / "rover", [logs])
    line = next(
        line for line in (tmp_path / "rover/README.md").read_text().splitlines() if " import " in line
    )
    assert shlex.split(line)[2] == str(logs)


def test_what_is_guessed_is_marked(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("x,cmd_x,won,reward\n" + "".join(f"{row},{row % 3},0,{row}\n" for row in range(9)))
    write_robot("slide", Path("slide"), [log])
    assert "fps = 10  # CHECK: the logs have no time field" in Path("slide/logs.toml").read_text()
    assert "[split]" not in Path("slide/logs.toml").read_text()
    assert '[columns."next.reward"]\nfields = ["reward"]' in Path("slide/logs.toml").read_text()
    assert Path("slide/slide.py").read_text().count("CHECK") == 7
    shown = CliRunner().invoke(app, ["new", "other", "--from", str(log)])
    assert "found no time field, so assumed 10 rows per second" in shown.output


def test_a_rate_that_is_no_whole_number_is_marked_and_imported(tmp_path: Path) -> None:
    rows = np.arange(40)
    table = np.column_stack([0.08 * rows, np.cumsum(rows % 3), rows % 3])
    np.savetxt("log.csv", table, "%.3f", ",", header="time,x,cmd_vx", comments="")
    shown = CliRunner().invoke(app, ["new", "slide", "--from", "log.csv"])
    why = (
        "the logs have 12.5 rows per second, not a whole number: TIMESTEP_S is 3.8% too short; "
        "resample them to 13 rows per second"
    )
    assert f"{why} (CHECK)" in shown.output
    assert f"fps = 13  # CHECK: {why}\n" in Path("slide/logs.toml").read_text()
    shutil.copy("log.csv", "again.csv")
    command("import log.csv again.csv --mapping slide/logs.toml")


@pytest.mark.parametrize("name", ["", "My", "a-b", "1st", "a.py", "../a"])
def test_a_name_is_one_of_a_file_and_a_task(name: str) -> None:
    told = "expected a name of a-z, 0-9 and _, such as my_cart, that begins with a letter$"
    with pytest.raises(BadInputError, match=told):
        write_robot(name, Path("out"))
    assert not Path("out").exists()


@pytest.mark.parametrize("name", ["class", "random", "torch", "logs", "mujoco", "rich"])
def test_a_name_is_taken_from_nothing_else(name: str) -> None:
    with pytest.raises(BadInputError, match=f"that Python does not use, such as my_{name}"):
        write_robot(name, Path("out"))
    assert not Path("out").exists()


def test_nothing_is_written_over_or_left_half_done(tmp_path: Path) -> None:
    (tmp_path / "cart").mkdir()
    with pytest.raises(BadInputError, match="cart exists already"):
        write_robot("cart", Path("cart"))
    with pytest.raises(BadInputError, match="no such file"):
        write_robot("other", Path("other"), [Path("nothing.csv")])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cart"]


def test_units_of_the_logs_are_those_of_the_task(tmp_path: Path) -> None:
    write_robot("arm", Path("arm"), [arm(tmp_path / "log.csv")])
    task = task_named("arm/arm.py:TASK")
    assert task.action.names == ("q1", "q2", "q3")
    assert task.state.astra is not None and [*task.state.astra["unit"]] == ["rad"] * 3
    assert task.action.astra is not None and [*task.action.astra["unit"]] == ["rad/s"] * 3


def test_a_hole_in_the_logs_is_marked_and_imported(tmp_path: Path) -> None:
    log = arm(tmp_path / "log.csv")
    lines = log.read_text().splitlines()
    cells = lines[20].split(",")
    lines[20] = ",".join([*cells[:3], "nan", *cells[4:]])
    log.write_text("\n".join(lines) + "\n")
    shown = CliRunner().invoke(app, ["new", "arm", "--from", str(log)])
    assert "q2_deg is not a number in 1 rows, which are left out: see logs.toml (CHECK)" in shown.output
    assert 'not_finite = "split"  # CHECK' in Path("arm/logs.toml").read_text()
    command("import log.csv --mapping arm/logs.toml --out imported")
    assert len(Dataset.open("imported")) == 3  # two trials, one of them in two


def test_a_log_whose_last_line_is_cut_off_is_taken_as_by_an_import(tmp_path: Path) -> None:
    log = arm(tmp_path / "log.csv")
    log.write_text(log.read_text().rstrip("\n").rpartition(",")[0])
    shown = CliRunner().invoke(app, ["new", "arm", "--from", str(log)])
    assert f"{log}: the last line is cut off and is left out, as it is by an import" in shown.output
    assert "not_finite" not in Path("arm/logs.toml").read_text()
    command("import log.csv --mapping arm/logs.toml --out imported")
    assert len(Dataset.open("imported")) == 2


def test_a_command_without_effect_and_a_heading_that_is_left_out_are_told(tmp_path: Path) -> None:
    rows = np.arange(30.0)
    table = np.column_stack([rows / 9, rows % 4, rows % 3, rows % 2])
    np.savetxt("log.csv", table, "%.6g", ",", header="x_m,yaw,cmd_x_m_s,cmd_fan_m_s2", comments="")
    write_robot("lift", Path("lift"), [Path("log.csv")])
    written = Path("lift/lift.py").read_text(encoding="utf-8")
    assert "# CHECK: what a command does; fan has no effect\n" in written
    assert "# φ, of NumPy arrays and of tensors, in which yaw is not: CHECK\n" in written
    told = "CHECK: fan has no effect; values that change as commanded: x by x; yaw is not in φ. The fields"
    assert told in Path("lift/README.md").read_text(encoding="utf-8")


def test_what_is_written_is_as_exact_as_the_logs(tmp_path: Path) -> None:
    """At 30 Hz, in places far from the origin, with a command of small values and one of large."""
    rows = np.arange(90)
    small, large = 2e-5 * np.sin(rows), 3e4 * np.cos(rows)
    table = np.column_stack([rows / 30, np.cumsum(small) / 30, 5.4e5 + np.cumsum(large) / 30, small, large])
    header = "time,x_m,y_🤖,cmd_x_m_s,cmd_y_🤖"
    with Path("log.csv").open("w", encoding="utf-8") as file:
        np.savetxt(file, table, "%.9g", ",", header=header, comments="")
    write_robot("far", Path("far"), [Path("log.csv")])
    task = task_named("far/far.py:TASK")
    (least, most), (lowest, highest) = task.limits.values()
    assert -2.01e-5 < least <= small.min() and small.max() <= most < 2.01e-5
    assert -3.01e4 < lowest <= large.min() and large.max() <= highest < 3.01e4
    tests = runpy.run_path("far/test_far.py")
    for test in ("test_no_piece_of_the_task_is_wrong", "test_a_step_of_the_simulator"):
        tests[test]()
    tests["test_phi_of_the_first_row_of_the_logs"]()
    assert tomllib.loads(Path("far/logs.toml").read_text(encoding="utf-8"))["time"] == "time"
    shutil.copy("log.csv", "again.csv")
    command("import log.csv again.csv --mapping far/logs.toml")


def test_of_two_fields_that_end_episodes_one_is_left_out_aloud(tmp_path: Path) -> None:
    rows = "".join(f"{row},{row % 3},{int(row == 8)},{int(row == 9)},{row}\n" for row in range(10))
    Path("log.csv").write_text("x,cmd_x,fell,collision,|v|\n" + rows)
    shown = CliRunner().invoke(app, ["new", "slide", "--from", "log.csv"])
    page = Path("slide/README.md").read_text()
    assert (
        "| left out | 1 | 1 | a second failure: combine both into one field |" in page and not shown.exit_code
    )
    assert '[columns."next.terminated"]\nfields = ["fell"]' in Path("slide/logs.toml").read_text()
    assert "| `\\|v\\|` | state v |" in page


def test_goals_of_the_logs_are_kept_for_who_wants_them(tmp_path: Path) -> None:
    log, rows = tmp_path / "log.csv", np.arange(20.0)
    columns = {"goal_x": 0 * rows + 3, "goal_y_cm": 0 * rows + 400, "x": rows, "y": rows % 7, "yaw": rows % 3}
    columns |= {"cmd_v": rows % 5, "cmd_w": rows % 2}
    np.savetxt(log, np.column_stack([*columns.values()]), "%.3f", ",", header=",".join(columns), comments="")
    write_robot("cart", tmp_path / "cart", [log])
    mapping = (tmp_path / "cart/logs.toml").read_text()
    assert "goal" not in "".join(line for line in mapping.splitlines() if not line.startswith("#"))
    commented = mapping[mapping.index("# [columns.") :].replace("# ", "")
    assert tomllib.loads(commented)["columns"]["observation.environment_state"] == {
        "fields": ["goal_x", "goal_y_cm"],
        "scale": [1.0, 0.01],
    }


def test_logs_may_be_given_as_a_shell_writes_them_out(tmp_path: Path) -> None:
    for name, rows in (("a.csv", 5), ("b.csv", 7), ("c.csv", 6)):
        Path(name).write_text("x[m],cmd_x\n" + "".join(f"{row},{row % 3}\n" for row in range(rows)))
    shown = CliRunner().invoke(app, ["new", "slide", "--from", "a.csv", "b.csv", "c.csv"])
    assert shown.exit_code == 0
    assert "x[m]" in shown.stdout  # brackets are no markup
    assert "horizon=7" in Path("slide/slide.py").read_text()
    recipe = tomllib.loads(Path("slide/slide.toml").read_text())
    assert recipe["ground"]["window"] == recipe["align"]["window"] == 2  # a history has two steps or more


@pytest.mark.parametrize("place", ["my_cart-logs", "my_cart-logs@data-1.0.0", "home/my_cart-logs/data-1.0.0"])
def test_a_dataset_is_begun_with_as_it_is(tmp_path: Path, place: str) -> None:
    command("new my_cart")
    command("import my_cart/logs --mapping my_cart/logs.toml")
    shown = CliRunner().invoke(app, ["new", "other", "--from", place])
    assert shown.exit_code == 0, shown.output
    assert "a unicycle: x, y, heading_x, heading_y, driven by v, w" in shown.stdout
    assert not Path("other/logs.toml").exists()
    page = Path("other/README.md").read_text()
    assert "logs.toml" not in page and "astra-data import" not in page
    data = tomllib.loads(Path("other/other.toml").read_text())["data"]
    assert data == str(tmp_path / "home/my_cart-logs/data-1.0.0")
    assert f"astra-data inspect {data} " in page
    one, other = (task_named(f"{name}/{name}.py:TASK") for name in ("my_cart", "other"))
    assert other.limits == one.limits and other.timestep_s == one.timestep_s == 0.1
    assert other.state == one.state and other.action == one.action
    assert check_task(other) == []
    assert check(Path("other/other.toml"))["data"].state == "finished"


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        (
            ["walks", "home/walks/data-1.1.0"],
            "walks and home/walks/data-1.1.0: expected .* `astra-data merge`",
        ),
        (["log.csv", "walks"], "log.csv and walks: expected logs, or one dataset"),
        (["home/walks"], "walks contains versions of a dataset: name one of data-1.0.0, data-1.1.0"),
        (["walks@data-3.0.0"], "walks has no version data-3.0.0 in .*home; it has data-1.0.0, data-1.1.0"),
        (["walsk"], "walsk: no such file, folder or dataset: did you mean 'walks'"),
        (["a/b"], "a/b: no such file, folder or dataset"),
        (["bags"], "bags: expected CSV logs or a dataset, got a ROS recording, drive.mcap"),
    ],
)
def test_what_is_no_data_to_begin_with_is_told(tmp_path: Path, places: list[str], expected: str) -> None:
    for version in ("1.0.0", "1.1.0"):
        write_fake(tmp_path / f"home/walks/data-{version}")
    arm(tmp_path / "log.csv")
    (tmp_path / "bags").mkdir()
    (tmp_path / "bags/drive.mcap").touch()
    with pytest.raises(BadInputError, match=expected):
        write_robot("cart", Path("cart"), [Path(place) for place in places])
    assert not Path("cart").exists()


def test_what_lerobot_recorded_is_opened_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    driven(Path("recorded"), *ROS)
    shutil.rmtree("recorded/meta/astra")
    command("new base --from recorded")
    assert [line for line in caplog.messages if "recorded by LeRobot" in line] == caplog.messages != []
    assert len(caplog.messages) == 1


def test_a_command_that_never_changes_is_told(tmp_path: Path) -> None:
    given = np.column_stack([np.sin(np.arange(40)), np.zeros(40), np.cos(np.arange(40))])
    driven(Path("ros"), ROS[0], ("linear.x", "linear.y", "angular.z"), given)
    shown = CliRunner().invoke(app, ["new", "base", "--from", "ros"])
    still = "linear.y is 0 in all rows: no simulator can learn what it does"
    assert f"{still} (CHECK)\n" in shown.output
    assert f"# CHECK: what was recorded; {still}\n" in Path("base/base.py").read_text()
    assert check_task(task_named("base/base.py:TASK")) == []


ODOM = ("pose.pose.position.x", "pose.pose.position.y", "pose.pose.orientation.z", "pose.pose.orientation.w")
ROS = (tuple(f"/odom:{path}" for path in ODOM), ("/cmd_vel:linear.x", "/cmd_vel:angular.z"))
"""Names of states and commands, as of a mapping without `names`."""


def driven(
    place: Path, states: Sequence[str], commands: Sequence[str], given: Floats | None = None
) -> Floats:
    """Write a dataset of a unicycle: x, y, the quaternion's z and w, further commanded speeds; return it."""
    if given is None:
        given = np.random.default_rng(0).uniform([0, -1], [1, 1], (40, 2))
    yaw = np.concatenate([[0], np.cumsum(0.1 * given[:-1, -1])])
    ways = 0.1 * given[:, :1] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    place_m = np.concatenate([np.zeros((1, 2)), np.cumsum(ways, axis=0)[:-1]])
    values = np.column_stack([place_m, np.sin(yaw / 2), np.cos(yaw / 2), given])[:, : len(states)]
    columns = (
        Column(STATE, size=len(states), names=tuple(states)),
        Column(ACTION, size=len(commands), names=tuple(commands)),
    )
    with DatasetWriter(place, columns=columns, fps=10, task="drive", description=DESCRIPTION) as out:
        for uid in range(2):
            table = {STATE: values.astype(np.float32), ACTION: given.astype(np.float32)}
            out.add(Episode(uid, table))
    return np.asarray(values)


@pytest.mark.parametrize(
    ("states", "commands"),
    [
        ROS,
        ((*ROS[0], "/odom:twist.twist.linear.x", "/odom:twist.twist.angular.z"), ROS[1]),
        (("pose.x", "pose.y", "Orientation.z", "Orientation.w"), ("v", "/cmd_vel:angular.z")),
        (("robot's x", "robot's y", "Orientation.z", "Orientation.w"), ("robot's v", '"w"')),
    ],
)
def test_names_with_dots_and_quotes_are_understood_and_kept(
    states: Sequence[str], commands: Sequence[str]
) -> None:
    values = driven(Path("ros"), states, commands)
    kind = write_robot("base", Path("base"), [Path("ros")])
    moved = ", ".join(states[:4])
    assert kind.simulator == f"a unicycle: {moved}, driven by {commands[0]}, {commands[1]}"
    task = task_named("base/base.py:TASK")
    assert check_task(task) == []
    assert task.state.names == tuple(states) and list(task.limits) == list(commands)
    simulator = task.make_simulator(39)
    simulator.reset_to(torch.from_numpy(task.abstraction(values[:-1])).float())
    given = Dataset.open("ros").columns([ACTION])[ACTION][:39]
    landed = simulator.step(torch.from_numpy(given))
    np.testing.assert_allclose(landed, task.abstraction(values[1:]), atol=1e-5)


def test_what_never_moves_is_a_part_of_the_task(tmp_path: Path) -> None:
    names = ("shoulder.pos", "gripper.pos")
    columns = (Column(STATE, size=2, names=names), Column(ACTION, size=2, names=names))
    angles = np.column_stack([np.sin(np.arange(30) / 5), np.full(30, 0.5)]).astype(np.float32)
    with DatasetWriter(Path("arm"), columns=columns, fps=10, task="hold", description=DESCRIPTION) as out:
        for uid in range(2):
            out.add(Episode(uid, {STATE: angles, ACTION: angles}))
    write_robot("still", Path("still"), [Path("arm")])
    task = task_named("still/still.py:TASK")
    assert check_task(task) == []
    least, largest = task.limits["gripper.pos"]
    assert least <= 0.5 < largest
    observed = task.objective.observe(torch.from_numpy(angles), torch.zeros(30, 0))
    assert observed.isfinite().all()


@pytest.mark.parametrize("names", [("x", "y"), ("shoulder.pos", "elbow.pos")])
def test_a_dataset_with_goals_is_taken_as_it_is(names: tuple[str, str], tmp_path: Path) -> None:
    state = Column(STATE, size=2, names=names)
    columns = (state, replace(state, name=NEXT_STATE), Column(ACTION, size=2), Column(GOAL, size=3))
    with DatasetWriter(Path("arm"), columns=columns, fps=10, task="reach", description=DESCRIPTION) as out:
        for uid in range(3):
            ways = np.random.default_rng(uid).normal(size=(30, 2)).astype(np.float32)
            goals = np.full((30, 3), uid, np.float32)
            states = np.cumsum(ways, axis=0)
            values = {STATE: states, NEXT_STATE: states + ways, ACTION: ways, GOAL: goals}
            out.add(Episode(uid, values))
    shown = CliRunner().invoke(app, ["new", "reach", "--from", "arm"])
    assert shown.exit_code == 0, shown.output
    assert f"| `{GOAL} g2` | goal | 1 | 1 | its column |" in Path("reach/README.md").read_text()
    task = task_named("reach/reach.py:TASK")
    assert check_task(task) == [] and task.objective.goal_size == 3
    drawn = task.objective.draw_goals(np.random.default_rng(0), 99)
    assert drawn.shape == (99, 3) and 0 <= drawn.min() < 0.1 and 1.9 < drawn.max() <= 2
    assert check(Path("reach/reach.toml"))["data"].state == "finished"
