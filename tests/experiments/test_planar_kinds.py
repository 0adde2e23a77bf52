import re
import runpy
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from planar_logs import poses_of, step_as_logged, write
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.arrays import Floats
from astra_data.exchange.guessing import guess
from astra_data.exchange.importing import import_dataset
from astra_data.experiments.fitted_kinds import Bicycle
from astra_data.experiments.new_robot import write_robot
from astra_data.experiments.planar_kinds import Holonomic, Planar
from astra_data.experiments.robot_kinds import Direct
from astra_data.worlds.registry import task_named
from astra_data.worlds.walk_through import check_task


def drive(rows: int = 120, *, in_world: bool = False) -> tuple[Floats, Floats]:
    """Return poses (rows, 3), x, y and yaw, ten a second, and the commands (rows, 3): vx, vy, wz."""
    commands = np.random.default_rng(0).uniform(-1, 1, (rows, 3))
    return poses_of(*commands.T, in_world=in_world), commands


BASE = ("x", "y", "yaw", "vx", "vy", "wz", "cmd_vx", "cmd_vy", "cmd_wz")


@pytest.mark.parametrize("in_world", [False, True])
def test_a_base_that_drives_sideways_is_stepped_as_it_was_driven(tmp_path: Path, in_world: bool) -> None:
    poses, commands = drive(in_world=in_world)
    log = write(tmp_path / "log.csv", BASE, poses, 0.9 * commands, commands)
    kind = write_robot("mecanum", tmp_path / "mecanum", [log])
    assert isinstance(kind, Holonomic) and kind.is_in_world is in_world
    frame = "along x and y" if in_world else "forward and to the left"
    assert kind.simulator == f"a holonomic base: x, y, yaw, driven by vx, vy, wz, {frame}"
    np.testing.assert_allclose(kind.step(poses[:-1], commands[:-1]), poses[1:], atol=1e-6)
    task = task_named(f"{tmp_path}/mecanum/mecanum.py:TASK")
    step_as_logged(task, np.column_stack([poses, 0.9 * commands]), commands)
    tests = runpy.run_path(f"{tmp_path}/mecanum/test_mecanum.py")
    tests["test_a_step_of_the_simulator"]()
    tests["test_phi_of_the_first_row_of_the_logs"]()
    ahead = task.objective.observe(torch.tensor([[0.0, 0.0, 0.0, 1.0]]), torch.zeros(1, 0))[0]
    goal = torch.tensor([float(value) for value in kind.values()["goal"].strip("()").split(",")])
    torch.testing.assert_close(ahead, goal if in_world else torch.stack([goal[1], -goal[0]]))
    shutil.copy(log, tmp_path / "again.csv")
    import_dataset([log, tmp_path / "again.csv"], tmp_path / "mecanum/logs.toml", out=tmp_path / "data")


@pytest.mark.parametrize("axes", ["xyzw", "zw", "wz"])
def test_a_base_whose_heading_is_a_quaternion_is_stepped_as_it_was_driven(tmp_path: Path, axes: str) -> None:
    poses, commands = drive()
    half = poses[:, 2] / 2
    tilt = 1e-5 * np.sin(np.arange(len(half)))  # of a floor that is nearly flat
    part = {"x": tilt, "y": -tilt, "z": np.sin(half), "w": np.cos(half)}
    names = ["cmd_vx", "cmd_vy", "cmd_wz", *(f"orientation.{axis}" for axis in axes), "x", "y"]
    quaternion = np.column_stack([part[axis] for axis in axes])
    log = write(tmp_path / "log.csv", names, commands, quaternion, poses[:, :2])
    kind = write_robot("mecanum", tmp_path / "mecanum", [log])
    assert isinstance(kind, Planar) and kind.names == ("x", "y", "yaw")
    np.testing.assert_allclose(kind.step(poses[:-1], commands[:-1])[:, :2], poses[1:, :2], atol=1e-6)
    task = task_named(f"{tmp_path}/mecanum/mecanum.py:TASK")
    assert check_task(task) == []
    states = np.column_stack([quaternion, poses[:, :2]])
    pose = np.column_stack([poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    np.testing.assert_allclose(task.abstraction(states), pose, atol=1e-6)
    seen = task.abstraction(torch.from_numpy(states))
    torch.testing.assert_close(seen, torch.from_numpy(pose), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    "names",
    [
        ("cmd_wz", "cmd_vy", "cmd_vx"),
        ("cmd_vel.angular.z", "cmd_vel.linear.y", "cmd_vel.linear.x"),
        ("cmd_yaw_rate", "cmd_vel_y", "cmd_vel_x"),
        ("u_vyaw", "u_vy", "u_vx"),
        ("cmd_yaw_rad_s", "cmd_y_m_s", "cmd_x_m_s"),
        ("cmd_omega", "cmd_v_y", "cmd_v_x"),
    ],
)
def test_two_speeds_and_a_turn_rate_have_many_names(tmp_path: Path, names: Sequence[str]) -> None:
    poses, commands = drive()
    vector = np.column_stack([poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    log = write(tmp_path / "log.csv", ["x", "y", "theta_x", "theta_y", *names], vector, commands[:, ::-1])
    kind = Holonomic.of(guess([log]))
    assert kind is not None and kind.meanings == ["turn", "left", "forward"]
    landed = kind.step(kind.states()[0][:-1], commands[:-1, ::-1])
    np.testing.assert_allclose(landed[:, :2], poses[1:, :2], atol=1e-6)


@pytest.mark.parametrize(
    "names",
    [
        ("cmd_yaw_rate", "cmd_sway", "cmd_surge"),
        ("yaw_rate_cmd", "sway_cmd", "surge_cmd"),
        ("cmd_w_rad_s", "cmd_sway_m_s", "cmd_surge_m_s"),
        ("cmd_wz", "cmd_body_sway_velocity", "cmd_body_surge_velocity"),
    ],
)
@pytest.mark.parametrize("in_world", [False, True])
def test_surge_and_sway_are_speeds_along_the_vessel_whatever_its_logs_say(
    tmp_path: Path, names: Sequence[str], in_world: bool
) -> None:
    poses, commands = drive(in_world=in_world)
    log = write(tmp_path / "log.csv", ["x", "y", "heading", *names], poses, commands[:, ::-1])
    kind = Holonomic.of(guess([log]))
    assert kind is not None and kind.meanings == ["turn", "left", "forward"] and not kind.is_in_world
    along, _ = drive()
    landed = kind.step(along[:-1], commands[:-1, ::-1])
    np.testing.assert_allclose(landed, along[1:], atol=1e-6)


@pytest.mark.parametrize(
    "names",
    [
        ("cmd_vx", "cmd_vy", "cmd_grip"),
        ("cmd_surge", "cmd_heave", "cmd_wz"),
        ("cmd_surge", "cmd_sway", "cmd_yaw"),
        ("cmd_surge_n", "cmd_sway_n", "cmd_wz"),  # forces
        ("cmd_vx", "cmd_vy", "cmd_yaw"),  # where to look
        ("cmd_vx", "cmd_vz", "cmd_wz"),
        ("cmd_x_m", "cmd_y_m", "cmd_wz"),  # where to be
    ],
)
def test_other_commands_are_no_holonomic_base(tmp_path: Path, names: Sequence[str]) -> None:
    poses, commands = drive()
    assert (
        Holonomic.of(guess([write(tmp_path / "a.csv", ["x", "y", "yaw", *names], poses, commands)])) is None
    )
    three = ("x", "y", "z", "cmd_vx", "cmd_vy", "cmd_wz")
    assert Holonomic.of(guess([write(tmp_path / "b.csv", three, poses, commands)])) is None


@pytest.mark.parametrize("command", ["cmd_wz", "cmd_w", "cmd_omega", "cmd_yaw_rate", "cmd_vyaw"])
def test_a_turn_rate_moves_the_heading(tmp_path: Path, command: str) -> None:
    poses, commands = drive()
    names = [command.removeprefix("cmd_"), "theta", command]
    log = write(tmp_path / "log.csv", names, 0.9 * commands[:, 2], poses[:, 2], commands[:, 2])
    kind = Direct.of(guess([log]))
    assert [field.short for field in kind.moved] == ["theta"] and kind.is_rate == (True,)


@pytest.mark.parametrize("unit", ["", "_rad_s"])
def test_a_turn_rate_of_no_heading_is_where_it_is_put(tmp_path: Path, unit: str) -> None:
    poses, commands = drive()  # a state that happens to rise as if the command were its rate
    log = write(tmp_path / "log.csv", [f"wz{unit}", f"cmd_wz{unit}"], poses[:, 2], commands[:, 2])
    kind = Direct.of(guess([log]))
    assert [field.short for field in kind.moved] == ["wz"] and kind.is_rate == (False,)


@pytest.mark.parametrize(
    ("names", "meanings"),
    [
        (("cmd_throttle", "cmd_steering"), ["speed", "turn"]),
        (("cmd_vtheta", "cmd_v"), ["turn", "speed"]),
        (("cmd_vx", "cmd_vy"), None),
        (("cmd_vx", "cmd_wz"), ["speed", "turn"]),
    ],
)
def test_a_unicycle_has_a_speed_and_a_turn_rate(
    tmp_path: Path, names: Sequence[str], meanings: list[str] | None
) -> None:
    poses, commands = drive()
    log = write(tmp_path / "log.csv", ["x", "y", "yaw", *names], poses, commands[:, :2])
    kind = Planar.of(guess([log]))
    assert (kind and kind.meanings) == meanings


@pytest.mark.parametrize(
    ("names", "meanings", "doubt"),
    [
        (("cmd_a", "cmd_b"), ["speed", "turn"], "b is used as a turn rate, although nothing says so"),
        (
            ("cmd_a_rad_s", "cmd_b_rad_s"),
            ["speed", "turn"],
            "b is used as a turn rate, although nothing says so",
        ),
        (("cmd_a_rad_s", "cmd_b_m_s"), ["turn", "speed"], ""),
        (("cmd_a_m_s", "cmd_b_rad_s"), ["speed", "turn"], ""),
        (("cmd_a_rad_s", "cmd_turn"), ["speed", "turn"], ""),
        (("cmd_v", "cmd_w"), ["speed", "turn"], ""),
    ],
)
def test_a_turn_rate_of_which_nothing_tells_is_told(
    tmp_path: Path, names: Sequence[str], meanings: list[str], doubt: str
) -> None:
    poses, commands = drive()
    log = write(tmp_path / "log.csv", ["x", "y", "yaw", *names], poses, commands[:, :2])
    kind = Planar.of(guess([log]))
    assert kind is not None and kind.meanings == meanings
    shown = CliRunner().invoke(app, ["new", "cartlet", "--from", str(log), "--out", str(tmp_path / "out")])
    told = f"; {doubt} (CHECK)\n" if doubt else "\n"
    assert re.search(rf"simulator: a unicycle: x, y, yaw, driven by \w+, \w+{re.escape(told)}", shown.output)
    step = f"    def step(self, command):{doubt and f'  # CHECK: {doubt}'}\n"
    assert step in (tmp_path / "out/cartlet.py").read_text()
    assert check_task(task_named(f"{tmp_path}/out/cartlet.py:TASK")) == []


@pytest.mark.parametrize(
    "names",
    [
        ("cmd_left", "cmd_right"),
        ("cmd_right_wheel_rad_s", "cmd_left_wheel_rad_s"),
        ("u_l", "u_r"),
        ("cmd_vl", "cmd_vr"),
        ("cmd_left_rot_speed", "cmd_right_rot_speed"),
    ],
)
def test_wheels_of_the_left_and_the_right_are_no_unicycle(tmp_path: Path, names: Sequence[str]) -> None:
    poses, commands = drive()
    log = write(tmp_path / "log.csv", ["x", "y", "theta", *names], poses, commands[:, :2])
    assert Planar.of(guess([log])) is None and Bicycle.of(guess([log])) is None
    assert isinstance(write_robot("wheels", tmp_path / "wheels", [log]), Direct)
