import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.io.guessing import Logs, guess
from astra_data.io.recording import find_sources

RAMP = np.arange(6.0)
LATE = RAMP > 4


def write(path: Path, columns: Mapping[str, object], rows: int = 6) -> Path:
    table = np.column_stack([np.broadcast_to(np.asarray(values, float), rows) for values in columns.values()])
    np.savetxt(path, table, "%.10g", ",", header=",".join(columns), comments="")
    return path


def found(folder: Path, *logs: Mapping[str, object]) -> Logs:
    folder.mkdir(exist_ok=True)
    for number, columns in enumerate(logs):
        write(folder / f"log{number}.csv", columns)
    return guess([folder])


ROLES: dict[str, tuple[dict[str, object], dict[str, str]]] = {
    "names and units": (
        {"x_mm": RAMP, "Pose.Y": RAMP, "q2": RAMP, "wheel rpm": RAMP, "cmd_v_kmh": RAMP, "u2": RAMP},
        {
            "x_mm": "state x m 0.001",
            "Pose.Y": "state pose_y m 1",
            "q2": "state q2 rad 1",
            "wheel rpm": "state wheel rad/s 0.1047",
            "cmd_v_kmh": "command v m/s 0.2778",
            "u2": "command u2 1 1",
        },
    ),
    "times of topics": (
        {
            "stamp_motors": 7 + RAMP // 2,
            "t": RAMP / 10,
            "gps_time_utc_usec": 1e9 + 1e5 * RAMP,
            "ros_timestamp_setpoint": 8 + RAMP,
            "time_to_goal": -RAMP,
            "x": RAMP,
            "cmd": RAMP,
        },
        {"stamp_motors": "left out", "t": "time s 1", "gps_time_utc_usec": "left out"}
        | {"ros_timestamp_setpoint": "left out", "time_to_goal": "state time_to_goal 1 1"},
    ),
    "ROS": (
        {"header.stamp": 5e7 * RAMP, "pose.position.x": RAMP, "cmd_vel.angular.z": RAMP, "done": LATE},
        {
            "header.stamp": "time ns 1e-09",
            "pose.position.x": "state pose_position_x m 1",
            "cmd_vel.angular.z": "command vel_angular_z 1 1",
            "done": "left out",
        },
    ),
    "torques": (
        {"q": RAMP, "torque_roll": RAMP, "thrust": RAMP, "cmd_q": RAMP},
        {"torque_roll": "state torque_roll N m 1", "thrust": "state thrust N 1"},
    ),
    "positions": (
        {"east": RAMP, "gps_northing": RAMP, "altitude": RAMP, "angular_x": RAMP, "body_q_x": RAMP, "rudder": RAMP},
        {"east": "state east m 1", "gps_northing": "state gps_northing m 1", "altitude": "state altitude m 1"}
        | {"angular_x": "state angular_x 1 1", "body_q_x": "state body_q_x 1 1", "rudder": "command rudder 1 1"},
    ),
    "latitude": (
        {"gps_latitude": 60 + RAMP / 1e5, "gps_longitude": RAMP / 1e5, "lat": RAMP, "cmd": RAMP},
        {"gps_latitude": "state gps_latitude m 1.112e+05", "gps_longitude": "state gps_longitude m 5.56e+04"}
        | {"lat": "state lat 1 1"},  # may be lateral
    ),
    "headings": (
        {"compass": 70 * RAMP, "cog": RAMP, "Heading [°]": RAMP, "cmd": RAMP},
        {"compass": "state compass rad 0.01745", "cog": "state cog rad 1"}
        | {"Heading [°]": "state heading rad 0.01745"},
    ),
    "percents": (
        {"Motor [%]": RAMP, "throttle_pct": RAMP, "cmd_left_percent": RAMP},
        {"Motor [%]": "state motor 1 0.01", "cmd_left_percent": "command left 1 0.01"},
    ),
    "outcomes": (
        {"x": RAMP, "cmd": RAMP, "e_stop": LATE, "fell": LATE, "docked": LATE, "reward": RAMP},
        {"e_stop": "failure", "fell": "left out", "docked": "success", "reward": "reward"},
    ),
    "a flag that ends its log": ({"x": RAMP, "cmd": RAMP, "folded": LATE}, {"folded": "failure"}),
    "a flag that ends nothing": ({"x": RAMP, "cmd": RAMP, "grip": RAMP == 2}, {"grip": "left out"}),
    "goals": (
        {"x": RAMP, "cmd": RAMP, "goal_x_cm": 4, "target_y": 7, "dist_to_goal": RAMP, "waypoint": RAMP},
        {"goal_x_cm": "goal m 0.01", "target_y": "goal m 1", "dist_to_goal": "state dist_to_goal 1 1"}
        | {"waypoint": "state waypoint 1 1"},
    ),
    "two of one name": (
        {"x_mm": RAMP, "x_cm": RAMP, "cmd": RAMP},
        {"x_mm": "state x m 0.001", "x_cm": "state x_cm m 0.01"},
    ),
    "an axis is no unit": (
        {"x": RAMP, "cmd_v": RAMP, "u_a": RAMP, "motor_v": RAMP},
        {"cmd_v": "command v 1 1", "u_a": "command a 1 1", "motor_v": "state motor V 1"},
    ),
}


@pytest.mark.parametrize("kind", ROLES)
def test_names_and_values_tell_roles_and_units(kind: str, tmp_path: Path) -> None:
    columns, expected = ROLES[kind]
    fields = {field.name: field for field in found(tmp_path, columns).fields}
    for name, taken in expected.items():
        field = fields[name]
        has_unit = field.role in ("state", "command", "goal", "time")
        unit = f" {field.unit} {field.scale:.4g}" if has_unit else ""
        assert f"{field.taken_for}{unit}" == taken


def test_a_flag_is_offered_as_a_failure_with_its_reason(tmp_path: Path) -> None:
    rows = {"x": RAMP, "cmd": RAMP}
    logs = found(tmp_path, rows | {"folded": 0}, rows | {"folded": LATE}, rows | {"folded": RAMP > 3})
    assert logs.fields[-1].role == "failure"
    assert logs.fields[-1].why == "0 or 1, and it ends all 2 of 3 episodes that have a 1 (CHECK)"
    write(tmp_path / "log3.csv", rows | {"folded": RAMP == 3})
    assert guess([tmp_path]).fields[-1].role == "left out"


def test_positions_keep_their_steps_in_float32(tmp_path: Path) -> None:
    columns = {"north": 5.3e6 + 0.01 * RAMP, "goal_north": 5.3e6 + 1, "x": RAMP, "cmd": RAMP}
    logs = found(tmp_path, columns)
    north, goal, x, _ = logs.fields
    assert north.offset == goal.offset == -5.3e6 and x.offset == 0
    stored = logs.episodes[0]["north"].astype(np.float32)
    np.testing.assert_allclose(np.diff(stored), 0.01, rtol=1e-3)


@pytest.mark.parametrize("before", [[], [{"latitude": math.nan}]])  # where the first log has no fix
def test_degrees_north_and_east_become_meters(tmp_path: Path, before: list[dict[str, float]]) -> None:
    east = {"longitude": 11 + RAMP / 1e4, "latitude": 60 - RAMP / 1e4, "cmd": RAMP}
    values = found(tmp_path, *(east | log for log in before), *[east] * 10).episodes[0]
    earth_m = 6_371_000 * math.tau / 360 / 1e4
    np.testing.assert_allclose(values["latitude"], -earth_m * RAMP, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(values["longitude"], earth_m / 2 * RAMP, rtol=1e-4, atol=1e-4)


def test_episodes_are_files_and_values_of_a_field(tmp_path: Path) -> None:
    rows = {"trial": RAMP // 4, "x": RAMP, "cmd": -RAMP}
    logs = found(tmp_path, rows, rows)
    (tmp_path / "named.csv").write_text("run,x,cmd\nfirst,0,0\nfirst,1,1\nother,2,2\nother,3,3\n")
    named = guess([tmp_path / "named.csv"])
    assert [values[:, 0].tolist() for values in logs.values(logs.of("state"))] == [[0, 1, 2, 3], [4, 5]] * 2
    assert [len(episode["x"]) for episode in named.episodes] == [2, 2]


@pytest.mark.parametrize(
    ("times", "rate", "is_even"),
    [
        (np.round(np.arange(90) / 30, 3), 30, True),
        (np.sort(np.append(np.round(np.arange(89) / 30, 3), 1.0)), 30, True),  # a row that is written twice
        (np.delete(np.arange(92), [7, 30]) / 10, 10, True),  # two rows that are not there
        (np.arange(90) / 29.7, 30, False),
        (np.arange(90) / 10 + 60.0 * (np.arange(90) > 50), 10, True),  # a pause
    ],
)
def test_the_rate_is_that_of_the_rows(times: Floats, rate: int, is_even: bool, tmp_path: Path) -> None:
    logs = guess([write(tmp_path / "log.csv", {"t": times, "x": times, "cmd": -times}, rows=90)])
    assert logs.rate == rate and (logs.uneven == "") is is_even


def test_rows_that_lack_a_number_are_left_out_and_counted(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t,x,cmd\n" + "".join(f"{row},{row},{row % 3}\n" for row in range(20)) + "20,,1\n21,1")
    logs = guess([log])
    assert logs.left_out == {"x": 1} and len(logs.episodes[0]["x"]) == 20 and logs.cut_off == (str(log),)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "expected CSV with a header"),
        (b"x,cmd\n1,2\n", "expected two rows or more below its header, got 1: leave it out"),
        (b"x,x,cmd\n1,2,3\n2,3,4\n", "log.csv: the header has x more than once"),
        (b"t,x\n0,1\n1,2\n2,3\n", "found no command among t (time), x (state): name one in the header, such as cmd_v"),
        (b"cmd,x\n0,1\n1,1\n", "found no state among cmd (command), x (left out): name one"),
        (
            b"x,cmd\n" + b"0,1\n" * 9 + b"1,2\n" * 9 + b"2,fast\n",
            "log.csv line 20: field 'cmd': expected numbers, or true",
        ),
        (b"x;cmd\n0,5;1\n1;2\n", "got semicolons in its header: write it with commas"),
        (b"x,neigung_\xb0,cmd\n0,0,0\n1,1,1\n", "expected text in UTF-8, got the byte 0xb0: save it as UTF-8"),
        (b"t_s,x,cmd\n0,0,0\n0.4,1,1\n0.8,2,2\n", "t_s: expected rows per second within 10% of a whole number"),
        (b"run,x,cmd\n0,0,0\n1,1,1\n2,2,2\n", "found none: look at run, which cut or lack rows"),
        (b'""\n1\n2\n', "log.csv: expected a header with a name for each field, got none: write one"),
        (
            b"t_s,x,cmd\n" + b"".join(b"%d,%d,\n" % (row, row) for row in range(20)) + b"19,20,1\n19,21,2\n",
            "t_s: expected rows per second within 10% of a whole number, as fps is one, got 0:",
        ),
        (
            b"t_s,x,cmd\n" + b"".join(b"%d,%d,%d\n" % (row // 2, row, row % 3) for row in range(20)),
            "t_s: expected a time that rises from row to row, got 10 rows in which it stands still and 0 in which",
        ),
    ],
)
def test_what_is_of_no_use_is_refused_in_one_line(content: bytes, expected: str, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_bytes(content)
    with pytest.raises(BadInputError, match=re.escape(expected)) as caught:
        guess([tmp_path / "log.csv"])
    assert "log.csv" in str(caught.value) and "\n" not in str(caught.value)


def test_files_have_the_same_fields(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"log1.csv: expected the fields of .*log0.csv, \['x', 'cmd'\]: got"):
        found(tmp_path, {"x": RAMP, "cmd": RAMP}, {"x": RAMP, "cmd_v": RAMP})


def test_where_the_time_goes_back_an_episode_begins(tmp_path: Path) -> None:
    time = np.concatenate([np.arange(30), np.arange(12)]) / 20
    place = write(tmp_path / "log.csv", {"time_s": time, "x": time**2, "cmd_v": np.sin(time)}, rows=42)
    logs = guess([place])
    assert [len(episode["x"]) for episode in logs.episodes] == [30, 12] and logs.recorded_rate == pytest.approx(20)
    assert logs.of("time")[0].why == "it goes back, where episodes begin (CHECK)"


def test_where_rows_are_lacking_an_episode_begins_as_in_an_import(tmp_path: Path) -> None:
    row = np.arange(40.0)
    time = row / 10 + 0.35 * (row >= 10) + 0.45 * (row >= 20)  # steps of 4.5 periods, and of 5.5
    x = np.where(np.isin(row, (30, 32)), np.nan, row)  # a single row is none
    write(tmp_path / "log.csv", {"t": time, "x": x, "cmd": row % 7}, 40)
    episodes = [one["x"].tolist() for one in guess([tmp_path]).episodes]
    assert episodes == [[*range(20)], [*range(20, 30)], [*range(33, 40)]]


def test_a_file_of_another_rate_is_named(tmp_path: Path) -> None:
    logs = [{"t": RAMP / rate, "x": RAMP, "cmd": -RAMP} for rate in (20, 21, 10)]
    assert found(tmp_path / "two", *logs[:2]).rate == 20
    with pytest.raises(BadInputError, match=r"log2.csv: expected 20 rows per second, as in other files, got 10: leave"):
        found(tmp_path, *logs)


def test_decimal_commas_are_told(tmp_path: Path) -> None:
    (tmp_path / "log.tsv").write_text("t\tx\tcmd_v\n0,0\t1\t2\n0,05\t1\t2\n")
    with pytest.raises(BadInputError, match=r"line 2: field 't': .* got '0,0': write decimal points, as in 0\.05$"):
        guess([tmp_path])


def test_a_link_to_nothing_is_named(tmp_path: Path) -> None:
    write(tmp_path / "log.csv", {"x": np.arange(6), "cmd": np.arange(6) % 2})
    (tmp_path / ".#log.csv").symlink_to("an editor's lock")
    assert len(find_sources([tmp_path], "csv", [".csv"])) == 1
    (tmp_path / "lost.csv").symlink_to(tmp_path / "nothing.csv")
    for read in (lambda: guess([tmp_path]), lambda: find_sources([tmp_path], "csv", [".csv"])):
        with pytest.raises(BadInputError, match=r"lost\.csv: a link to nothing: remove it"):
            read()
