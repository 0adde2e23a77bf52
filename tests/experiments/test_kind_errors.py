from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.exchange.guessing import guess
from astra_data.experiments.kind_errors import badly_predicted, errors
from astra_data.experiments.planar_kinds import Planar
from astra_data.experiments.robot_kinds import Direct


def slide(path: Path, sign: float, rows: int = 40) -> Path:
    """Write a log of `x` that changes, ten times a second, by a speed that is commanded."""
    speed = np.random.default_rng(0).uniform(0.5, 1, rows)
    x = 100 + sign * (np.cumsum(speed) - speed) / 10
    table = np.column_stack([np.arange(rows) / 10, x, speed])
    np.savetxt(path, table, "%.9f", ",", header="time,x,cmd_vx", comments="")
    return path


def test_errors_are_of_open_loops_from_each_row(tmp_path: Path) -> None:
    log = slide(tmp_path / "log.csv", 1)
    x = np.loadtxt(log, delimiter=",", skiprows=1)[:, 1]
    simulated, still = errors(Direct.of(guess([log])), 10)
    assert_allclose(simulated, 0, atol=1e-7)
    assert_allclose(still, np.abs(x[10:] - x[:-10]).mean())


def test_a_heading_is_never_more_than_half_a_turn_off(tmp_path: Path) -> None:
    yaw = np.arange(60) / 10
    wrapped = np.arctan2(np.sin(yaw), np.cos(yaw))
    turn = 1 + 1e-6 * (np.arange(60) % 2)
    columns = [np.arange(60) / 10, np.sin(yaw), 1 - np.cos(yaw), wrapped, turn, turn]
    header = "time,x,y,yaw,cmd_v,cmd_w"
    np.savetxt(tmp_path / "log.csv", np.column_stack(columns), "%.9f", ",", header=header, comments="")
    kind = Planar.of(guess([tmp_path / "log.csv"]))
    assert kind is not None
    simulated, still = errors(kind, 10)
    assert simulated[2] < 1e-4 and still[2] < 1.01
    assert (simulated[:2] < 0.1 * still[:2]).all()


def test_a_simulator_of_no_use_is_told(tmp_path: Path) -> None:
    for name, sign in (("ahead", 1), ("back", -1)):
        log = slide(tmp_path / f"{name}.csv", sign)
        assert badly_predicted(Direct.of(guess([log]))) == (["x"] if name == "back" else [])
        out = tmp_path / name
        shown = CliRunner().invoke(app, ["new", name, "--from", str(log), "--out", str(out)])
        line = (
            "after 10 steps it predicts each state of the logs worse than standing still would: "
            f"edit `step` in {out}/{name}.py\n"
        )
        assert shown.exit_code == 0 and (line in shown.output) is (name == "back"), shown.output


def test_a_state_that_is_predicted_worse_is_named_though_others_are_better(tmp_path: Path) -> None:
    rows, turn = np.arange(60), np.random.default_rng(0).uniform(0.5, 1, 60)
    yaw = (turn - np.cumsum(turn)) / 10  # the command is to the right
    speed = 1 + 0.1 * (rows % 2)
    x, y = (np.cumsum(speed * of(yaw)) / 10 - speed * of(yaw) / 10 for of in (np.cos, np.sin))
    for name, heading, columns in (("one", "yaw", [yaw]), ("two", "yaw_x,yaw_y", [np.cos(yaw), np.sin(yaw)])):
        table = np.column_stack([rows / 10, x, y, *columns, speed, turn])
        log, header = tmp_path / f"{name}.csv", f"time,x,y,{heading},cmd_v,cmd_w"
        np.savetxt(log, table, "%.9f", ",", header=header, comments="")
        kind = Planar.of(guess([log]))
        assert kind is not None and badly_predicted(kind) == ["yaw"]
    shown = CliRunner().invoke(app, ["new", "left", "--from", str(log), "--out", str(tmp_path / "left")])
    assert "after 10 steps it predicts yaw of the logs worse than standing still would: edit" in shown.output


@pytest.mark.parametrize(("factor", "is_told"), [(1.02, False), (1.1, True)])
def test_what_is_worse_by_chance_is_not_told(tmp_path: Path, factor: float, is_told: bool) -> None:
    command = (1 + factor) * (1 + 1e-6 * (np.arange(60) % 2))  # too fast by as much, so that it is ahead
    table = np.column_stack([np.arange(60) / 10, np.arange(60) / 10, command])
    np.savetxt(tmp_path / "log.csv", table, "%.9f", ",", header="time,x,cmd_vx", comments="")
    assert badly_predicted(Direct.of(guess([tmp_path / "log.csv"]))) == ["x"] * is_told


def test_logs_that_are_too_short_tell_nothing(tmp_path: Path) -> None:
    kind = Direct.of(guess([slide(tmp_path / "log.csv", -1, rows=8)]))
    assert np.isnan(errors(kind, 10)).all() and badly_predicted(kind) == []
