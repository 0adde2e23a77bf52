import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from astra_data.core.errors import BadInputError
from astra_data.exchange.guessing import guess
from astra_data.exchange.logs import RATE_HZ


def write(path: Path, columns: Mapping[str, object], rows: int = 6) -> Path:
    table = np.column_stack([np.broadcast_to(np.asarray(values, float), rows) for values in columns.values()])
    np.savetxt(path, table, "%.9g", ",", header=",".join(columns), comments="")
    return path


RAMP = np.arange(6.0)


def test_roles_and_units_are_told_by_names_and_values(tmp_path: Path) -> None:
    columns = {
        "t_ms": 50 * RAMP,
        "x_mm": 1000 * RAMP,
        "Pose.Y": RAMP,
        "heading": 90 * RAMP,
        "roll": RAMP / 10,
        "heading_x": np.cos(RAMP),
        "wheel rpm": 60 * RAMP,
        "twist.linear.x": RAMP**2,
        "cmd_v_mm_s": 100 * RAMP,
        "u2": RAMP,
        "tipped": RAMP > 4,
        "success": RAMP / 2,
        "frame_id": RAMP,
        "battery": 12.0,
    }
    logs = guess([write(tmp_path / "log.csv", columns)])
    found = {field.name: (field.taken_for, field.unit, field.scale) for field in logs.fields}
    assert found == {
        "t_ms": ("time", "ms", 1e-3),
        "x_mm": ("state x", "m", 1e-3),
        "Pose.Y": ("state pose_y", "m", 1.0),
        "heading": ("state heading", "rad", math.pi / 180),
        "roll": ("state roll", "rad", 1.0),
        "heading_x": ("state heading_x", "1", 1.0),
        "wheel rpm": ("state wheel", "rad/s", math.pi / 30),
        "twist.linear.x": ("state twist_linear_x", "1", 1.0),
        "cmd_v_mm_s": ("command v", "m/s", 1e-3),
        "u2": ("command u2", "1", 1.0),
        "tipped": ("failure", "1", 1.0),
        "success": ("state success", "1", 1.0),  # is more than true and false
        "frame_id": ("left out", "1", 1.0),
        "battery": ("left out", "1", 1.0),
    }
    assert logs.rate == 20
    np.testing.assert_allclose(logs.episodes[0]["heading"], math.pi / 2 * RAMP)


@pytest.mark.parametrize("name", ["ep", "ep_id", "Episode", "episode_index", "trial nr"])
def test_logs_are_cut_where_the_episode_changes(name: str, tmp_path: Path) -> None:
    log = write(tmp_path / "log.csv", {name: RAMP // 4, "x": RAMP, "cmd": -RAMP})
    logs = guess([log])
    assert logs.fields[0].role == "episode"
    assert [len(episode["x"]) for episode in logs.episodes] == np.bincount((RAMP // 4).astype(int)).tolist()


@pytest.mark.parametrize(
    ("ending", "unit", "scale"),
    [
        ("_mps", "m/s", 1),
        ("_m_per_s", "m/s", 1),
        (" [m/s]", "m/s", 1),
        ("_kmh", "m/s", 1000 / 3600),
        (" [km/h]", "m/s", 1000 / 3600),
        ("_kph", "m/s", 1000 / 3600),
        ("_m_s2", "m/s²", 1),
        ("_mps2", "m/s²", 1),
        (" (m/s²)", "m/s²", 1),
        (" [m/s^2]", "m/s²", 1),
        (" [°/s²]", "rad/s²", math.tau / 360),
        ("_rad_s2", "rad/s²", 1),
        ("_dps", "rad/s", math.tau / 360),
        ("_deg_per_s", "rad/s", math.tau / 360),
        (" [°/s]", "rad/s", math.tau / 360),
        ("_rad_per_s", "rad/s", 1),
        ("[°]", "rad", math.tau / 360),
        ("°", "rad", math.tau / 360),
    ],
)
def test_a_unit_has_many_spellings(tmp_path: Path, ending: str, unit: str, scale: float) -> None:
    log = tmp_path / "log.csv"
    header = f"motion{ending},cmd_motion{ending}"
    log.write_text(header + "\n" + "".join(f"{row},{row}\n" for row in range(6)), "utf-8")
    fields = guess([log]).fields
    assert [field.taken_for for field in fields] == ["state motion", "command motion"]
    assert [field.unit for field in fields] == [unit, unit]
    assert [field.scale for field in fields] == pytest.approx([scale, scale])


@pytest.mark.parametrize(
    ("step", "unit", "rate"), [(0.1, "s", 10), (20, "ms", 50), (5e4, "us", 20), (1e7, "ns", 100)]
)
def test_a_unit_of_time_is_told_by_its_steps(tmp_path: Path, step: float, unit: str, rate: int) -> None:
    logs = guess([write(tmp_path / "log.csv", {"stamp": 7 + step * RAMP, "x": RAMP, "cmd": RAMP})])
    (time,) = logs.of("time")
    assert (time.unit, logs.rate) == (unit, rate)


@pytest.mark.parametrize(
    ("step", "rate", "error"),
    [(0.08, 13, -0.038), (0.1, 10, 0.0), (0.22, 5, -0.091), (1 / 29.97, 30, -0.001)],
)
def test_the_rate_is_the_nearest_whole_number(tmp_path: Path, step: float, rate: int, error: float) -> None:
    logs = guess([write(tmp_path / "log.csv", {"t": step * RAMP, "x": RAMP, "cmd": RAMP})])
    assert logs.rate == rate and logs.rate_error == pytest.approx(error, abs=5e-4)
    assert (logs.uneven == "") is (abs(error) < 0.005)


def test_times_that_are_rounded_are_of_their_mean_rate(tmp_path: Path) -> None:
    times = np.round(np.arange(90) / 30, 3)
    logs = guess([write(tmp_path / "log.csv", {"t": times, "x": times, "cmd": times}, rows=90)])
    assert logs.rate == 30 and logs.uneven == ""


def test_a_row_that_is_written_twice_changes_no_rate(tmp_path: Path) -> None:
    times = np.sort(np.append(np.round(np.arange(90) / 30, 3), 1.0))
    logs = guess([write(tmp_path / "log.csv", {"t": times, "x": times, "cmd": times}, rows=91)])
    assert logs.rate == 30 and logs.uneven == ""


@pytest.mark.parametrize(("step", "measured", "rate"), [(0.4, "2.5", 3), (0.7, "1.429", 2), (3, "0.3333", 1)])
def test_a_rate_that_no_import_takes_is_refused(
    tmp_path: Path, step: float, measured: str, rate: int
) -> None:
    log = write(tmp_path / "log.csv", {"t_s": step * RAMP, "x": RAMP, "cmd": RAMP})
    with pytest.raises(
        BadInputError,
        match=rf"t_s: expected rows per second .*, got {measured}: .* logs to {rate} rows per second",
    ):
        guess([log])


def test_stamps_of_nanoseconds_are_read(tmp_path: Path) -> None:
    rows = "".join(f"{1_700_000_000_000_000_001 + 50_000_000 * row},{row},{row}\n" for row in range(9))
    (tmp_path / "log.csv").write_text("stamp,x,cmd\n" + rows)
    assert guess([tmp_path / "log.csv"]).rate == 20


def test_names_of_ros_are_read(tmp_path: Path) -> None:
    columns = {
        "header.stamp": 5e7 * RAMP,
        "header.stamp.nsecs": 5e7 * RAMP,
        "pose.position.x": RAMP,
        "pose.orientation.x": RAMP,
        "cmd_vel.linear.x": RAMP,
        "cmd_vel.linear.y": 0.0,
        "cmd_vel.angular.z": -RAMP,
        "done": RAMP > 4,
    }
    logs = guess([write(tmp_path / "log.csv", columns)])
    assert [(field.taken_for, field.unit) for field in logs.fields] == [
        ("time", "ns"),
        ("left out", "1"),
        ("state pose_position_x", "m"),
        ("state pose_orientation_x", "1"),
        ("command vel_linear_x", "1"),
        ("left out", "1"),
        ("command vel_angular_z", "1"),
        ("left out", "1"),
    ]
    assert logs.rate == 20
    assert logs.fields[-1].why == "an end, but which? name it success or failed"


def test_a_flag_is_no_state_and_its_end_is_to_be_named(tmp_path: Path) -> None:
    columns = {"x": RAMP, "cmd": RAMP, "arrived": RAMP > 4, "gear": 1 + (RAMP > 4), "failed": RAMP > 4}
    fields = guess([write(tmp_path / "log.csv", columns)]).fields
    assert [field.role for field in fields] == ["state", "command", "left out", "state", "failure"]
    assert fields[2].why == "0 or 1: name it success or failed if it is an end"


@pytest.mark.parametrize("stamp", [RAMP // 4, RAMP % 5])
def test_a_time_that_does_not_rise_is_left_out(tmp_path: Path, stamp: object) -> None:
    logs = guess([write(tmp_path / "log.csv", {"stamp": stamp, "x": RAMP, "cmd": RAMP})])
    assert (logs.fields[0].role, logs.fields[0].why) == ("left out", "a time that does not rise")


def test_what_rises_in_a_unit_of_time_is_a_time(tmp_path: Path) -> None:
    rest = {"trial": RAMP // 3, "x": RAMP, "cmd": -RAMP}
    restarts = 50 * (RAMP % 3)
    logs = guess([write(tmp_path / "a.csv", {"zeit_ms": restarts} | rest)])
    assert (logs.fields[0].role, logs.fields[0].unit, logs.rate) == ("time", "ms", 20)
    assert logs.fields[0].why == "its ending, and it increases in every row"
    np.testing.assert_allclose(logs.episodes[1]["zeit_ms"], [0, 0.05, 0.1])
    times: dict[str, object] = {"uptime_s": RAMP, "t": RAMP / 10, "age_us": 7 * RAMP}
    logs = guess([write(tmp_path / "b.csv", times | rest)])
    assert [field.role for field in logs.fields[:3]] == ["left out", "time", "left out"] and logs.rate == 10
    assert logs.fields[0].why == "a second time"
    others: dict[str, object] = {"delay_ms": RAMP // 2, "speed_m_s": RAMP, "wait_s": -RAMP, "load": RAMP}
    logs = guess([write(tmp_path / "c.csv", others | rest)])
    assert [field.role for field in logs.fields[:4]] == ["state"] * 4


def test_forces_are_commands_where_there_are_no_others(tmp_path: Path) -> None:
    columns = {"q1": RAMP, "q2": -RAMP, "tau1_nm": RAMP, "tau2_nm": -RAMP}
    taken = [field.taken_for for field in guess([write(tmp_path / "a.csv", columns)]).fields]
    assert taken == ["state q1", "state q2", "command tau1", "command tau2"]
    commanded = columns | {"cmd1": RAMP, "cmd2": -RAMP}
    taken = [field.taken_for for field in guess([write(tmp_path / "b.csv", commanded)]).fields]
    assert taken[2:] == ["state tau1", "state tau2", "command u1", "command u2"]


def test_pedals_and_a_wheel_are_commands_where_there_are_no_others(tmp_path: Path) -> None:
    car = {"x": RAMP, "throttle": RAMP % 3, "steering_angle": 10 * RAMP, "brake": RAMP % 4}
    fields = guess([write(tmp_path / "a.csv", car)]).fields
    assert [field.taken_for for field in fields] == [
        "state x",
        "command throttle",
        "command steering_angle",
        "command brake",
    ]
    assert (fields[1].why, fields[2].unit) == ("its name, and no other command", "rad")  # 50 are degrees
    for name in ("steer", "steering", "Steering Angle", "steer_angle", "steering_deg"):
        assert roles(tmp_path / "b", {"x": RAMP, name: RAMP})[name] == "command"
    for name in ("cmd_v", "u1", "target_speed"):
        found = roles(tmp_path / "c", car | {name: -RAMP})
        assert [*found.values()] == ["state"] * 4 + ["command"]
    placed = roles(tmp_path / "d", *({**car, "target_x": 1.0 + number} for number in range(2)))
    assert (placed["target_x"], placed["throttle"]) == ("goal", "command")


@pytest.mark.parametrize(
    ("others", "role"),
    [(("v", "cmd_surge"), "state u"), (("v",), "command command"), (("cmd_surge",), "command command")],
)
def test_u_is_a_speed_beside_v_where_something_else_is_commanded(
    tmp_path: Path, others: tuple[str, ...], role: str
) -> None:
    logs = guess(
        [write(tmp_path / "log.csv", {"x": RAMP, "u_m_s": -RAMP, **dict.fromkeys(others, RAMP % 3)})]
    )
    assert logs.fields[1].taken_for == role


def test_an_axis_is_no_unit(tmp_path: Path) -> None:
    columns = {"x": RAMP, "cmd_v": RAMP, "u_a": RAMP, "motor_v": RAMP, "cmd_deg": RAMP}
    logs = guess([write(tmp_path / "log.csv", columns)])
    assert [(field.short, field.unit) for field in logs.fields] == [
        ("x", "m"),
        ("v", "1"),
        ("a", "1"),
        ("motor", "V"),
        ("command", "rad"),
    ]


def test_episodes_are_files_and_values_of_a_field(tmp_path: Path) -> None:
    for name in ("one.csv", "two.tsv"):
        write(tmp_path / name, {"trial": RAMP // 4, "x": RAMP, "cmd": -RAMP})
    (tmp_path / "two.tsv").write_text((tmp_path / "two.tsv").read_text().replace(",", "\t"))
    (tmp_path / "notes.txt").write_text("none")
    logs = guess([tmp_path])
    assert [values[:, 0].tolist() for values in logs.values(logs.of("state"))] == [[0, 1, 2, 3], [4, 5]] * 2
    assert logs.rate == RATE_HZ


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "expected CSV with a header"),
        ("x,cmd\n", "expected two rows or more below its header, got 0: leave it out"),
        ("x,cmd\n1,2\n", "expected two rows or more below its header, got 1: leave it out"),
        ("x,x,cmd\n1,2,3\n2,3,4\n", "expected a header of different names"),
        (
            "t,x\n0,1\n1,2\n2,3\n",
            "found no command among t (time), x (state): name one in the header, such as cmd_v",
        ),
        ("cmd,x\n0,1\n1,1\n2,1\n", "found no state among cmd (command), x (left out): name one"),
        ("cmd,x\n1,0\n1,1\n1,2\n", "found no command among cmd (left out), x (state): name one"),
        (
            "t,x,cmd\n0,0,0\n,1,1\n2,2,2\n",
            "t: expected a number in each row of a time, got none in 1 of 3: leave",
        ),
        ("x,cmd\n0,0\n1,nan\n2,inf\n", "cmd: expected a number in each row of a command, got none in 2 of 3"),
        ("x_mm,x_cm,cmd\n0,0,0\n1,1,1\n2,2,2\n", "x_mm and x_cm would both become state x: rename one"),
        ("x,cmd_v,u_v\n0,0,0\n1,1,1\n", "cmd_v and u_v would both become command v: rename one"),
        (
            "x;cmd\n0,5;1\n1;2\n",
            "expected fields parted by commas, got semicolons in its header: write it with commas, or with",
        ),
    ],
)
def test_what_is_of_no_use_is_told(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(BadInputError, match=f"log.csv: {re.escape(expected)}"):
        guess([tmp_path / "log.csv"])


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            b"x,neigung_\xb0,cmd\n0,0,0\n1,1,1\n",
            ": expected text in UTF-8, got the byte 0xb0: save it as UTF-8",
        ),
        ("x,cmd\n0,0\n1,1\n".encode("utf-16"), ": expected text in UTF-8, got UTF-16: save it as UTF-8"),
        (
            b"x,cmd\n0,0\n\n1\n2,2\n",
            " cannot be read as csv: line 4: Expected 2 columns, got 1: write as many fields there as in the "
            "header, or leave the line out",
        ),
        (
            b"# log of today\nx,cmd\n0,0\n1,1\n",
            " cannot be read as csv: line 2: Expected 1 columns, got 2: leave out what is above the header, "
            "'# log of today'",
        ),
        (
            b"# x, y\nx,y,cmd\n0,0,0\n",
            " cannot be read as csv: line 2: Expected 2 columns, got 3: leave out what is above the header, "
            "'# x'",
        ),
    ],
)
def test_why_a_file_is_no_csv_is_told_in_one_line(tmp_path: Path, content: bytes, expected: str) -> None:
    log = tmp_path / "log.csv"
    log.write_bytes(content)
    with pytest.raises(BadInputError) as caught:
        guess([log])
    assert str(caught.value) == f"{log}{expected}"


def test_a_last_line_that_is_cut_off_is_left_out(tmp_path: Path) -> None:
    whole, cut = tmp_path / "1.csv", tmp_path / "2.csv"
    whole.write_text("x,y,cmd\n0,0,0\n1,1,1\n2,2,2")
    cut.write_text("x,y,cmd\n0,0,0\n1,1,1\n2,2")
    logs = guess([whole, cut])
    assert [len(values) for values in logs.values(logs.of("state"))] == [3, 2]
    assert logs.cut_off == (str(cut),)
    assert logs.left_out == {}


def test_a_dataset_is_no_logs(tmp_path: Path) -> None:
    (tmp_path / "arm/meta").mkdir(parents=True)
    (tmp_path / "arm/meta/info.json").write_text('{"codebase_version": "v3.0"}')
    with pytest.raises(BadInputError, match=r"arm is a LeRobot dataset, .*inspect \S+/arm`, or as `data`"):
        guess([tmp_path / "arm"])


def test_files_have_to_be_there_and_alike(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"expected files that end in \.csv or \.tsv, found none"):
        guess([tmp_path])
    (tmp_path / "log.h5").write_bytes(b"\x89HDF")
    with pytest.raises(BadInputError, match=r"log\.h5: expected files that end in .*: convert other formats"):
        guess([tmp_path / "log.h5"])
    with pytest.raises(BadInputError, match="no such file"):
        guess([tmp_path / "log.csv"])
    one = write(tmp_path / "one.csv", {"x": RAMP, "cmd": RAMP})
    two = write(tmp_path / "two.csv", {"y": RAMP, "cmd": RAMP})
    with pytest.raises(
        BadInputError, match=r"two\.csv: expected the fields of .*one\.csv, \['x', 'cmd'\]: got"
    ):
        guess([one, two])
    more = write(tmp_path / "more.csv", {"x": RAMP, "cmd": RAMP, "y": RAMP})
    with pytest.raises(BadInputError, match=r"more\.csv: expected the fields of .*: got \['x', 'cmd', 'y'\]"):
        guess([one, more])


def test_fields_may_be_in_another_order_from_file_to_file(tmp_path: Path) -> None:
    one = write(tmp_path / "one.csv", {"x": RAMP, "cmd": -RAMP})
    two = write(tmp_path / "two.csv", {"cmd": -2 * RAMP, "x": 2 * RAMP})
    logs = guess([one, two])
    assert [values[:, 0].tolist() for values in logs.values(logs.of("state"))] == [[*RAMP], [*(2 * RAMP)]]
    assert [values[:, 0].tolist() for values in logs.values(logs.of("command"))] == [[*-RAMP], [*(-2 * RAMP)]]


def test_rows_without_a_number_are_left_out_and_told(tmp_path: Path) -> None:
    x, y = np.arange(30.0), np.arange(30.0) ** 2
    x[[4, 17]] = np.nan
    sparse = np.where(np.arange(30) % 5, np.nan, y)
    log = write(tmp_path / "log.csv", {"x": x, "y": y, "gps": sparse, "cmd_x": np.arange(30) % 3}, rows=30)
    logs = guess([log])
    found = {field.name: (field.role, field.why) for field in logs.fields}
    assert found["x"][0] == found["y"][0] == "state"
    assert found["gps"] == ("left out", "no number in 24 rows")
    assert logs.left_out == {"x": 2}
    assert [len(values) for values in logs.values(logs.of("state"))] == [28]
    assert np.isfinite(logs.values(logs.of("state"))[0]).all()


def test_a_text_among_numbers_is_refused_with_its_line(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    rows = [f"{row},{row % 3}" for row in range(20)]
    rows[7] = "oops,1"
    log.write_text("\n".join(["x,cmd_x", *rows, ""]))
    with pytest.raises(BadInputError, match=r"log.csv line 9: x: expected a number, got 'oops'$"):
        guess([log])
    log.write_text("\n\n".join(["x,cmd_x", *rows, ""]))
    with pytest.raises(BadInputError, match=r"log.csv line 17: x: expected a number, got 'oops'$"):
        guess([log])


def test_texts_and_dates_are_left_out_with_the_reason(tmp_path: Path) -> None:
    log, empty = tmp_path / "log.csv", tmp_path / "log_2.csv"
    head = "time,x,mode,cmd_x\n"
    log.write_text(
        head + "".join(f"2024-01-01 12:00:{row},{row}.5,driving,{row % 3}\n" for row in range(10, 30))
    )
    empty.write_text(head + "".join(f",{row}.5,,{row % 3}\n" for row in range(20)))
    logs = guess([log, empty])
    assert [field.taken_for for field in logs.fields] == ["left out", "state x", "left out", "command x"]
    why = {field.name: field.why for field in logs.fields}
    assert (
        why["time"]
        == why["mode"]
        == "texts, dates or nothing: expected numbers, of a time in s, ms, us or ns"
    )
    assert [values.tolist() for values in logs.values(logs.of("command"))[1:]] == [
        [[row % 3] for row in range(20)]
    ]


def test_a_field_that_one_log_alone_has_is_left_out_if_it_holds_no_numbers(tmp_path: Path) -> None:
    for name, more in (("a.csv", ",note"), ("b.csv", "")):
        rows = "".join(f"{row},{row}{more}\n" for row in range(6))
        (tmp_path / name).write_text(f"x,cmd_x{more}\n{rows}")
    assert [field.name for field in guess([tmp_path]).fields] == ["x", "cmd_x"]
    (tmp_path / "c.csv").write_text("x,cmd_x,y\n" + "".join(f"{row},{row},{row}\n" for row in range(6)))
    with pytest.raises(BadInputError, match=r"c.csv: expected the fields of .*\['x', 'cmd_x'\]: got \['x', "):
        guess([tmp_path])


def test_blanks_are_no_numbers_as_in_an_import(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("x,cmd_x\n" + "".join(f"{' ' if row == 7 else row}, {row} \n" for row in range(40)))
    logs = guess([log])
    assert logs.left_out == {"x": 1}
    (commands,) = logs.values(logs.of("command"))
    assert commands[:, 0].tolist() == [row for row in range(40) if row != 7]


def test_texts_tell_episodes_apart(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("run,x,cmd_x\n" + "".join(f"{'b' if row < 8 else 'a'},{row},{row}\n" for row in range(20)))
    logs = guess([log])
    assert logs.fields[0].role == "episode"
    assert [len(values) for values in logs.values(logs.of("state"))] == [8, 12]


@pytest.mark.parametrize("name", ["flight", "Lap", "session_id", "bag nr", "run_index", "traj"])
def test_whole_numbers_of_what_is_flown_or_driven_tell_episodes_apart(tmp_path: Path, name: str) -> None:
    log = write(tmp_path / "log.csv", {name: RAMP // 3, "x": RAMP, "cmd": RAMP})
    logs = guess([log])
    assert logs.fields[0].role == "episode" and len(logs.episodes) == 2
    shares = {name: RAMP / 3, "goal_x": RAMP, "x": RAMP, "cmd": RAMP}  # which part of a lap is behind it
    logs = guess([write(tmp_path / "log.csv", shares)])
    assert [field.role for field in logs.fields] == ["state", "state", "state", "command"]
    assert len(logs.episodes) == 1


def test_a_name_without_letters_or_digits_is_left_out(tmp_path: Path) -> None:
    columns = {"": RAMP, "t": RAMP / 10, "x": RAMP, "θ": RAMP, "cmd": RAMP}
    (tmp_path / "log.csv").write_text(write(tmp_path / "log.txt", columns).read_text("latin-1"), "utf-8")
    fields = guess([tmp_path / "log.csv"]).fields
    assert [field.role for field in fields] == ["left out", "time", "state", "left out", "command"]


def test_texts_may_share_a_name(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("note,x,note,cmd\n" + "".join(f"a,{row},b,{row}\n" for row in range(6)))
    assert [field.name for field in guess([log]).fields] == ["note", "x", "cmd"]
    log.write_text("note,x,note,cmd\n" + "".join(f"a,{row},{row},{row}\n" for row in range(6)))
    with pytest.raises(BadInputError, match="expected a header of different names"):
        guess([log])


@pytest.mark.parametrize("time", [{}, {"t": RAMP / 10}])
def test_a_number_of_the_row_makes_no_episodes(tmp_path: Path, time: dict[str, object]) -> None:
    log = write(tmp_path / "log.csv", {**time, "trial": RAMP, "x": RAMP, "cmd": RAMP})
    with pytest.raises(BadInputError, match=r"episodes of two rows .* trial changes in every row: leave it"):
        guess([log])


def test_goals_are_told_from_states_and_commands(tmp_path: Path) -> None:
    files = [
        write(
            tmp_path / f"{number}.csv",
            {
                "goal_x": 3.0 + number,
                "goal_yaw_deg": 90.0 * number,
                "target_x": 2.0 + number,
                "target_y": RAMP,
                "target_q1": 1.0 + number,
                "dist_to_goal": RAMP[::-1],
                "goal_reached": RAMP > 4,
                "pose_x": RAMP,
                "cmd_v": -RAMP,
            },
        )
        for number in range(2)
    ]
    logs = guess(files)
    found = {field.name: (field.role, field.unit, field.why) for field in logs.fields}
    assert found == {
        "goal_x": ("goal", "m", "its name"),
        "goal_yaw_deg": ("goal", "rad", "its ending"),
        "target_x": ("goal", "1", "constant in each episode"),
        "target_y": ("command", "1", "no unit in its name"),
        "target_q1": ("command", "1", "no unit in its name"),
        "dist_to_goal": ("state", "1", "no unit in its name"),
        "goal_reached": ("success", "1", "its name"),
        "pose_x": ("state", "m", "its name"),
        "cmd_v": ("command", "1", "no unit in its name"),
    }


def test_a_hole_in_a_command_is_one_as_in_a_state(tmp_path: Path) -> None:
    command = np.arange(30.0) % 3
    command[[4, 17]] = np.nan
    whole = write(tmp_path / "a.csv", {"t": np.arange(30) / 10, "x": np.arange(30), "cmd_x": 1.0}, rows=30)
    holes = {"t": np.arange(30) / 10, "x": np.arange(30), "cmd_x": command}
    logs = guess([whole, write(tmp_path / "b.csv", holes, rows=30)])
    assert logs.left_out == {"cmd_x": 2}
    assert [len(values) for values in logs.values(logs.of("state"))] == [30, 28]
    times = np.where(np.arange(30) == 7, np.nan, np.arange(30) / 10)
    write(tmp_path / "b.csv", holes | {"t": times}, rows=30)
    with pytest.raises(BadInputError, match=r"b\.csv: t: expected a number in each row of a time"):
        guess([whole, tmp_path / "b.csv"])


def roles(folder: Path, *files: Mapping[str, object]) -> dict[str, str]:
    folder.mkdir(exist_ok=True)
    logs = [write(folder / f"{number}.csv", columns) for number, columns in enumerate(files)]
    return {field.name: field.role for field in guess(logs).fields}


def test_what_changes_within_an_episode_is_no_goal(tmp_path: Path) -> None:
    state = {"x": RAMP, "cmd_v": -RAMP}
    found = roles(tmp_path / "a", state | {"heading_to_goal": RAMP, "waypoint": RAMP, "goal_x": RAMP // 2})
    assert {found[name] for name in ("heading_to_goal", "waypoint", "goal_x")} == {"state"}
    found = roles(tmp_path / "b", state | {"goal_x": RAMP // 2, "drive": RAMP // 2})
    assert found["goal_x"] == "goal"
    found = roles(tmp_path / "c", state | {"goal_x": 3.0, "goal_y": 0.0, "goal": RAMP > 4})
    assert (found["goal_x"], found["goal_y"], found["goal"]) == ("goal", "goal", "left out")


def test_a_place_that_is_all_that_is_commanded_is_a_command(tmp_path: Path) -> None:
    steps: list[dict[str, object]] = [{"x": RAMP, "ref_x": 1.0 + number} for number in range(2)]
    assert roles(tmp_path / "a", *steps)["ref_x"] == "command"
    pushed = [one | {"tau_1": -RAMP} for one in steps]
    assert roles(tmp_path / "b", *pushed) == {"x": "state", "ref_x": "goal", "tau_1": "command"}
    driven: list[dict[str, object]] = [
        {"x": RAMP, "target_x": 1.0 + number, "cmd_x": -RAMP} for number in range(2)
    ]
    assert roles(tmp_path / "c", *driven)["target_x"] == "goal"
    other: dict[str, object] = {"x": RAMP, "cmd_v": -RAMP}
    one_moves = roles(tmp_path / "d", other | {"target_x": 1.0}, other | {"target_x": RAMP})
    assert one_moves["target_x"] == "command"


def test_a_bumper_is_a_failure_where_it_ever_comes_and_nothing_else_is(tmp_path: Path) -> None:
    state = {"x": RAMP, "cmd_v": -RAMP}
    assert roles(tmp_path / "a", state | {"bumper": RAMP > 4})["bumper"] == "failure"
    assert roles(tmp_path / "b", state | {"e_stop": 0.0})["e_stop"] == "left out"
    both = roles(tmp_path / "c", {"estop": RAMP > 3} | state | {"fell": RAMP > 4})
    assert (both["estop"], both["fell"]) == ("left out", "failure")
    assert roles(tmp_path / "d", state | {"at_goal": RAMP > 4})["at_goal"] == "success"
