"""Robots on wheels of known dimensions: what is fitted to their logs are these dimensions."""

import runpy
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from planar_logs import poses_of, step_as_logged, wrapped, write
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.arrays import Floats
from astra_data.exchange.guessing import guess
from astra_data.experiments.fitted_kinds import Bicycle, Differential
from astra_data.experiments.new_robot import write_robot
from astra_data.worlds.registry import task_named


def steer(wheelbase_m: float, rows: int = 120) -> tuple[Floats, Floats]:
    """Return poses (rows, 3) of a car, ten a second, and the commands (rows, 2), speed and angle."""
    commands = np.random.default_rng(0).uniform([-0.5, -0.4], [2, 0.4], (rows, 2))
    speed, angle = commands.T
    turn = speed * np.tan(angle) / wheelbase_m
    poses = poses_of(speed, np.zeros(rows), turn)
    return wrapped(poses), commands


@pytest.mark.parametrize("wheelbase_m", [0.26, -0.26])
@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_a_car_is_steered_by_an_angle(tmp_path: Path, wheelbase_m: float, order: list[int]) -> None:
    poses, commands = steer(wheelbase_m)
    names = ["cmd_v", "cmd_steering_angle"]
    columns = ["x", "y", "yaw", *(names[column] for column in order)]
    log = write(tmp_path / "log.csv", columns, poses, commands[:, order])
    shown = CliRunner().invoke(app, ["new", "racer", "--from", str(log), "--out", str(tmp_path / "racer")])
    driven = ", ".join(["v", "steering_angle"][column] for column in order)
    side = ", steered to the right" if wheelbase_m < 0 else ""
    line = f"abstract simulator: a bicycle: x, y, yaw, driven by {driven}, wheelbase 0.26 m{side}\n"
    assert line in shown.output and "standing still" not in shown.output
    assert "WHEELBASE_M = 0.26  # CHECK" in (tmp_path / "racer/racer.py").read_text()
    task = task_named(f"{tmp_path}/racer/racer.py:TASK")
    simulator = step_as_logged(task, poses, commands[:, order])
    assert simulator.parameters == {"timestep_s": 0.1, "wheelbase_m": 0.26}
    runpy.run_path(f"{tmp_path}/racer/test_racer.py")["test_a_step_of_the_simulator"]()


@pytest.mark.parametrize("name", ["cmd_steering", "cmd_wz"])
def test_a_rate_of_turning_is_no_steering_angle(tmp_path: Path, name: str) -> None:
    commands = np.random.default_rng(0).uniform(-1, 1, (120, 2))
    speed, turn = commands.T
    columns = ["x", "y", "yaw", "cmd_v", name]
    turned = write(tmp_path / "log.csv", columns, poses_of(speed, np.zeros(120), turn), commands)
    assert Bicycle.of(guess([turned])) is None
    assert write_robot("robot", tmp_path / "robot", [turned]).simulator.startswith("a unicycle")


def test_a_steering_rate_is_no_angle_even_where_it_would_fit(tmp_path: Path) -> None:
    poses, commands = steer(0.26)
    columns = ["x", "y", "yaw", "cmd_v", "cmd_steering_rad_s"]
    assert Bicycle.of(guess([write(tmp_path / "log.csv", columns, poses, commands)])) is None
    columns[-1] = "cmd_steering_rad"
    assert Bicycle.of(guess([write(tmp_path / "log.csv", columns, poses, commands)])) is not None


def test_a_car_that_never_drives_has_no_wheelbase(tmp_path: Path) -> None:
    poses, commands = steer(0.26)
    commands[:, 0] = 0.5 * (np.arange(len(commands)) == len(commands) - 1)  # in the last row alone
    columns = ["x", "y", "yaw", "cmd_v", "cmd_steer"]
    assert Bicycle.of(guess([write(tmp_path / "log.csv", columns, poses, commands)])) is None


RADIUS_M, TRACK_M = 0.033, 0.16


def roll(track_m: float = TRACK_M, rows: int = 200, lag: float = 0.0) -> tuple[Floats, Floats]:
    """Return poses (rows, 3), ten a second, and commands (rows, 2) of a left and a right wheel in rad/s."""
    commands = np.random.default_rng(0).uniform(-4, 10, (rows, 2))
    turned = np.zeros((rows, 2))
    for row in range(rows):
        turned[row] = lag * turned[row - 1] + (1 - lag) * commands[row]
    left, right = RADIUS_M * turned.T
    poses = poses_of((left + right) / 2, np.zeros(rows), (right - left) / track_m)
    return wrapped(poses), commands


@pytest.mark.parametrize("track_m", [TRACK_M, -TRACK_M])
@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_two_wheels_are_a_differential_drive(tmp_path: Path, track_m: float, order: list[int]) -> None:
    poses, commands = roll(track_m)
    names = ["cmd_left_wheel_rad_s", "cmd_right_wheel_rad_s"]
    columns = ["x", "y", "theta", *(names[column] for column in order)]
    log = write(tmp_path / "log.csv", columns, poses, commands[:, order])
    shown = CliRunner().invoke(app, ["new", "burger", "--from", str(log), "--out", str(tmp_path / "burger")])
    driven = ", ".join(["left_wheel", "right_wheel"][column] for column in order)
    side = ", left and right exchanged" if track_m < 0 else ""
    line = (
        f"abstract simulator: a differential drive: x, y, theta, driven by {driven}, "
        f"0.033 m/s of a wheel for each rad/s, track 0.16 m{side}\n"
    )
    assert line in shown.output and "standing still" not in shown.output
    task = task_named(f"{tmp_path}/burger/burger.py:TASK")
    simulator = step_as_logged(task, poses, commands[:, order])
    assert simulator.parameters == {
        "timestep_s": 0.1,
        "speed_per_command": RADIUS_M,
        "track_m": track_m,
    }
    runpy.run_path(f"{tmp_path}/burger/test_burger.py")["test_a_step_of_the_simulator"]()


@pytest.mark.parametrize(
    ("names", "meanings"),
    [
        (("cmd_vl", "cmd_vr"), ["left", "right"]),
        (("u_r", "u_l"), ["right", "left"]),
        (("cmd_wheel_right_m_s", "cmd_wheel_left_m_s"), ["right", "left"]),
        (("cmd_left_pwm", "cmd_right_pwm"), ["left", "right"]),
        (("cmd_left_m", "cmd_right_m"), None),  # where to be
        (("cmd_left_rad", "cmd_right_rad"), None),
        (("cmd_front", "cmd_rear"), None),
    ],
)
def test_wheels_have_many_names(tmp_path: Path, names: Sequence[str], meanings: list[str] | None) -> None:
    poses, commands = roll()
    order = [0, 1] if meanings != ["right", "left"] else [1, 0]
    log = write(tmp_path / "log.csv", ["x", "y", "yaw", *names], poses, commands[:, order])
    kind = Differential.of(guess([log]))
    assert (kind and kind.meanings) == meanings
    if kind:
        np.testing.assert_allclose([kind.speed_per_command, kind.track_m], [RADIUS_M, TRACK_M], rtol=1e-6)


def test_wheels_that_lag_behind_their_commands_have_the_same_dimensions(tmp_path: Path) -> None:
    poses, commands = roll(lag=0.5, rows=2000)
    columns = ["x", "y", "yaw", "cmd_left_rad_s", "cmd_right_rad_s"]
    kind = Differential.of(guess([write(tmp_path / "log.csv", columns, poses, commands)]))
    assert kind is not None
    np.testing.assert_allclose([kind.speed_per_command, kind.track_m], [RADIUS_M, TRACK_M], rtol=0.15)


@pytest.mark.parametrize("still", ["speed", "turn"])
def test_wheels_that_never_drive_or_never_turn_have_no_dimensions(tmp_path: Path, still: str) -> None:
    commands = np.random.default_rng(0).uniform(-1, 1, (120, 1)) * [1, -1 if still == "speed" else 1]
    left, right = commands.T
    poses = poses_of((left + right) / 2, np.full(120, 0.1), right - left + 0.01)
    columns = ["x", "y", "yaw", "cmd_left", "cmd_right"]
    log = write(tmp_path / "log.csv", columns, poses, commands)
    assert Differential.of(guess([log])) is None
