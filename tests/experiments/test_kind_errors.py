from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.exchange.guessing import guess
from astra_data.experiments.kind_errors import errors, is_of_no_use
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
        assert is_of_no_use(Direct.of(guess([log]))) is (name == "back")
        out = tmp_path / name
        shown = CliRunner().invoke(app, ["new", name, "--from", str(log), "--out", str(out)])
        line = (
            "after 10 steps it predicts each state of the logs worse than standing still does: "
            f"edit `step` in {out}/{name}.py\n"
        )
        assert shown.exit_code == 0 and (line in shown.output) is (name == "back"), shown.output


def test_logs_that_are_too_short_tell_nothing(tmp_path: Path) -> None:
    kind = Direct.of(guess([slide(tmp_path / "log.csv", -1, rows=8)]))
    assert np.isnan(errors(kind, 10)).all() and not is_of_no_use(kind)
