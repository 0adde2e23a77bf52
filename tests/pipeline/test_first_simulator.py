import runpy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.io.guessing import guess
from astra_data.pipeline.first_simulator import first_simulator
from astra_data.pipeline.new_robot import write_robot
from astra_data.robots.registry import task_named
from astra_data.worlds.walk_through import check_task

STEP_S = 0.1
Columns = dict[str, Floats]


def held(*bounds: tuple[float, float], rows: int = 240) -> Floats:
    """Return commands (A, rows), each held for three steps."""
    lows, highs = np.transpose(bounds)
    given = np.random.default_rng(0).uniform(lows, highs, (rows // 3, len(bounds)))
    return np.asarray(np.repeat(given, 3, axis=0).T)


def summed(rates: Floats) -> Floats:
    """Return what changes at such rates, from 0."""
    return np.asarray(np.cumsum(STEP_S * rates) - STEP_S * rates)


def driven(forward: Floats, left: Floats, turn: Floats) -> tuple[Floats, Floats, Floats]:
    """Return x, y and the yaw of a robot with such speeds in its own frame."""
    yaw = summed(turn)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return summed(forward * cos - left * sin), summed(forward * sin + left * cos), yaw


def wrapped(yaw: Floats) -> Floats:
    return np.asarray(np.arctan2(np.sin(yaw), np.cos(yaw)))


def unicycle() -> Columns:
    v, w = held((0, 2), (-2, 2))
    x, y, yaw = driven(v, 0 * v, w)
    return {"x": x, "y": y, "yaw": wrapped(yaw), "cmd_w": w, "cmd_v": v}


def of_other_axes() -> Columns:
    """A boat with a compass in degrees, whose turns are clockwise."""
    columns = unicycle()
    compass = np.degrees(np.pi / 2 - columns.pop("yaw")) % 360
    east, north = columns.pop("x") + 4e5, columns.pop("y") + 5e6
    return {
        "north": north,
        "east": east,
        "heading": compass,
        "cmd_v": columns["cmd_v"],
        "cmd_yaw_rate": -columns["cmd_w"],
    }


def bicycle() -> Columns:
    """A tractor with a trailer, whose angle no command moves."""
    v, angle = held((-1, 2), (-0.5, 0.5))
    x, y, yaw = driven(v, 0 * v, v * np.tan(angle) / 2.5)
    hitch = np.sin(yaw)
    place = {"trailer_x": x - 4, "trailer_y": y, "trailer_heading": yaw / 2, "x": x, "y": y, "heading": wrapped(yaw)}
    return place | {"hitch_angle": hitch, "cmd_speed": v, "cmd_steering": angle}


def differential() -> Columns:
    left, right = held((-5, 10), (-5, 10))
    x, y, yaw = driven(0.1 * (left + right) / 2, 0 * left, 0.1 * (right - left) / 0.4)
    return {"x": x, "y": y, "theta": wrapped(yaw), "cmd_left_rad_s": left, "cmd_right_rad_s": right}


def vessel() -> Columns:
    surge, sway, heave, turn = held((0, 2), (-1, 1), (-1, 1), (-1, 1))
    x, y, yaw = driven(surge, sway, turn)
    speeds = {"cmd_surge": surge, "cmd_sway": sway, "cmd_heave": heave, "cmd_yaw_rate": turn}
    return {"x": x, "y": y, "z": summed(heave), "qz": np.sin(yaw / 2), "qw": np.cos(yaw / 2), **speeds}


def drone() -> Columns:
    """Driven along the axes of the world."""
    vx, vy, vz, turn = held((-2, 2), (-2, 2), (-1, 1), (-1, 1))
    place = {"x": summed(vx), "y": summed(vy), "z": summed(vz), "yaw": wrapped(summed(turn))}
    return place | {"vx_sp": vx, "vy_sp": vy, "vz_sp": vz, "yawspeed_sp": turn}


def arm() -> Columns:
    """Joints that rates move, a gripper that is where it is put, and a fan that moves nothing."""
    rates, grip, fan = held((-1, 1)), held((0, 1)), held((0, 9))
    states = {"elbow_deg": 90 + np.degrees(summed(rates[0])), "grip": np.roll(grip[0], 1), "load": np.arange(240.0)}
    return states | {"cmd_elbow_dps": np.degrees(rates[0]), "cmd_grip": grip[0], "cmd_fan": fan[0]}


def pushed() -> Columns:
    (torque,) = held((-0.2, 0.2))
    speed = summed(2.5 * torque)
    return {"q1": summed(speed + STEP_S * 2.5 * torque), "dq1": speed, "tau1": torque}


KINDS: dict[str, tuple[Callable[[], Columns], str]] = {
    "unicycle": (unicycle, "a unicycle: x, y, yaw, moved by w, v"),
    "of other axes": (
        of_other_axes,
        "a unicycle: east, north, heading, moved by v, yaw_rate; speed_per_command 1; turn_per_command -1; "
        "CHECK: heading is clockwise from the axis of y, as of a compass",
    ),
    "bicycle": (
        bicycle,
        "a bicycle: x, y, heading, moved by speed, steering; wheelbase_m 2.5; "
        "CHECK: trailer_heading and hitch_angle are not in φ, though failures may come of them",
    ),
    "differential drive": (
        differential,
        "a differential drive: x, y, theta, moved by left, right; speed_per_command 0.1; track_m 0.4",
    ),
    "vessel": (vessel, "a holonomic base: x, y, qz, qw, moved by surge, sway, yaw_rate; CHECK: heave has no effect"),
    "drone": (drone, "values that commands move: x, y, z, yaw, moved by vx, vy, vz, yawspeed"),
    "arm": (arm, "values that commands move: elbow, grip, moved by elbow, grip; CHECK: fan has no effect"),
    "pushed": (pushed, "values that commands move: q1, dq1, moved by tau1; dq1_per_force 2.5"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_simulator_of_its_kind_steps_as_the_logs_do(kind: str, tmp_path: Path) -> None:
    columns, expected = KINDS[kind][0](), KINDS[kind][1]
    table = np.column_stack([STEP_S * np.arange(240), *columns.values()])
    np.savetxt(tmp_path / "log.csv", table, "%.12g", ",", header=",".join(["t", *columns]), comments="")
    simulator = write_robot("robot", tmp_path / "robot", [tmp_path / "log.csv"])
    assert simulator.described == expected
    task = task_named(f"{tmp_path}/robot/robot.py:TASK")
    assert check_task(task) == []
    (states,), (given,) = (simulator.logs.values(simulator.logs.of(role)) for role in ("state", "command"))
    rows = torch.from_numpy(states)
    stepped = task.make_simulator(239)
    stepped.reset_to(task.abstraction(rows[:-1]))
    landed = stepped.step(torch.from_numpy(given[:-1]))
    torch.testing.assert_close(landed, task.abstraction(rows[1:]), atol=2e-3, rtol=0)
    torch.testing.assert_close(task.abstraction(rows), torch.from_numpy(task.abstraction(states)))
    tests = runpy.run_path(f"{tmp_path}/robot/test_robot.py")
    tests["test_phi_and_a_step_from_the_first_row_of_the_logs"]()
    simulated, still = simulator.errors()
    assert (simulated < 0.1 * still + 1e-6).all()


def test_the_second_command_turns_where_no_name_says_which(tmp_path: Path) -> None:
    columns = unicycle()
    a, b = columns.pop("cmd_v"), columns.pop("cmd_w")
    table = np.column_stack([*columns.values(), a, b])
    np.savetxt(tmp_path / "log.csv", table, "%.9g", ",", header="x,y,yaw,cmd_a,cmd_b", comments="")
    doubt = "(CHECK: b is used as a turn rate, although nothing says so)"
    assert first_simulator(guess([tmp_path / "log.csv"])).described == f"a unicycle {doubt}: x, y, yaw, moved by a, b"


@pytest.mark.parametrize(
    ("header", "moved", "idle"),
    [
        ("x,vx,cmd_vx", "x", ""),
        ("vx,y,cmd_vx", "vx", ""),
        ("x,y,cmd", None, ""),
        ("x,cmd", "x", ""),
        ("x,wx,torque_roll,x_setpoint,qz_setpoint", "x", "qz has no effect"),
        ("x,y,cmd_surge,cmd_x", "x", "surge has no effect"),
        ("x_m,tilt_rad,cmd_x_m_s,cmd_tilt_m_s", "x", "tilt has no effect"),
        ("joint1_pos,joint1_vel,joint1_torque_nm", "joint1_pos, joint1_vel", ""),
    ],
)
def test_a_command_moves_the_state_of_its_name_and_no_other(
    header: str, moved: str | None, idle: str, tmp_path: Path
) -> None:
    rows = np.random.default_rng(0).normal(size=(40, header.count(",") + 1))
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header=header, comments="")
    if moved is None:
        with pytest.raises(BadInputError, match="found no state that a command could move: name it as its"):
            first_simulator(guess([tmp_path / "log.csv"]))
        return
    simulator = first_simulator(guess([tmp_path / "log.csv"]))
    assert ", ".join(field.short for entry in simulator.entries for field in entry.fields) == moved
    assert "; ".join(simulator.remarks) == idle
