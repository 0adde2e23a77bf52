from pathlib import Path

import numpy as np
import pytest

from astra_data.core.errors import BadInputError
from astra_data.exchange.guessing import guess
from astra_data.exchange.logs import Field, Logs
from astra_data.experiments.planar_kinds import Planar
from astra_data.experiments.robot_kinds import Direct

T = np.arange(50.0)


def logs(folder: Path, **columns: object) -> Logs:
    table = np.column_stack([np.asarray(values, float) for values in columns.values()])
    np.savetxt(folder / "log.csv", table, "%.6f", ",", header=",".join(columns), comments="")
    return guess([folder / "log.csv"])


def test_a_position_a_heading_and_two_commands_are_a_unicycle(tmp_path: Path) -> None:
    found = logs(
        tmp_path,
        vel_x=np.cos(T),
        vel_y=np.sin(T),
        a=T % 7,
        yaw=T % 3 / 2,
        x=T,
        y=2 * T,
        cmd_w=T % 5,
        cmd_v=T % 2,
    )
    kind = Planar.of(found)
    assert kind is not None
    values = kind.values()
    assert [field.short for field in kind.position] == ["x", "y"]
    assert "state[..., 4], state[..., 5], of.cos(yaw)" in values["abstraction"]
    assert (values["commands"], values["command"]) == ("turn, speed", "[0.0, 1.0]")
    assert values["goal"] == "(49.0, 98.0)" and values["lows"] == values["highs"] == "[0.0, 0.0, 0.0]"
    assert float(values["close"]) == pytest.approx(np.hypot(49, 98) / 10, rel=0.05)
    assert values["phi"] == "[0.0, 0.0, 1.0, 0.0]"  # x, y, cosine and sine
    # Toward y for a tenth of a second at a speed of 1.
    assert (values["before"], values["after"]) == ("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.1, 0.0, 1.0]")


def test_a_heading_may_be_a_unit_vector(tmp_path: Path) -> None:
    found = logs(tmp_path, heading_x=-np.cos(T), heading_y=np.sin(T), x=T, y=T % 9, cmd_v=T % 5, cmd_w=T % 2)
    kind = Planar.of(found)
    assert kind is not None
    assert kind.values()["abstraction"] == "return state[..., [2, 3, 0, 1]]"
    assert kind.values()["lows"] == "[0.0, 0.0, 3.14159265]"


def test_the_second_command_turns_where_no_name_says_which(tmp_path: Path) -> None:
    found = logs(tmp_path, x=T, y=T % 9, yaw=T % 3, cmd_a=T % 5, cmd_b=T % 2)
    kind = Planar.of(found)
    assert kind is not None
    assert (kind.values()["commands"], kind.values()["command"]) == ("speed, turn", "[1.0, 0.0]")


def test_a_unit_vector_goes_before_an_angle(tmp_path: Path) -> None:
    vector = {"heading_x": np.cos(T), "heading_y": np.sin(T)}
    kind = Planar.of(logs(tmp_path, x=T, y=T % 9, yaw=T % 3, **vector, cmd_v=T % 5, cmd_w=T % 2))
    assert kind is not None and [field.short for field in kind.heading.fields] == ["heading_x", "heading_y"]


def test_starts_and_the_goal_are_those_of_the_episodes(tmp_path: Path) -> None:
    episode = np.repeat([0, 1, 2], [10, 25, 15])  # the last one goes as far as the median
    pose = {"x": 2 * T, "y": -T, "yaw": T % 5 / 9}
    planar = Planar.of(logs(tmp_path, episode=episode, **pose, cmd_v=T % 5, cmd_w=T % 2))
    assert planar is not None
    values = planar.values()
    assert (values["lows"], values["highs"]) == ("[0.0, -35.0, 0.0]", "[70.0, 0.0, 0.0]")
    assert values["goal"] == "(98.0, -49.0)" and values["close"] == f"{np.hypot(28, 14) / 10:.2g}"
    values = Direct.of(logs(tmp_path, episode=episode, a=2 * T, cmd_a=T % 5)).values()
    assert (values["lows"], values["highs"], values["goal"]) == ("[0.0]", "[70.0]", "(98.0,)")
    assert (values["range"], values["close"]) == ("(98.0,)", f"{28 / 98 / 10:.2g}")  # of the range


@pytest.mark.parametrize(
    ("crashed", "end"),
    [((), 24), ((1,), 49), ((1, 2), 9), ((0, 1, 2), 24)],
)
def test_the_goal_is_no_place_of_a_collision_unless_all_ended_so(
    tmp_path: Path, crashed: tuple[int, ...], end: int
) -> None:
    lengths = [10, 15, 25]  # the second one goes as far as the median
    episode, last = np.repeat([0, 1, 2], lengths), np.isin(T, np.cumsum(lengths) - 1)
    flags = {"collision": last & np.isin(episode, crashed)} if crashed else {}
    pose = {"x": 2 * T, "y": -T, "yaw": T % 5 / 9}
    planar = Planar.of(logs(tmp_path, episode=episode, **pose, cmd_v=T % 5, cmd_w=T % 2, **flags))
    assert planar is not None and planar.values()["goal"] == f"({2.0 * end}, {-1.0 * end})"
    direct = Direct.of(logs(tmp_path, episode=episode, a=2 * T, cmd_a=T % 5, **flags))
    assert direct.values()["goal"] == f"({2.0 * end},)"


def test_others_are_no_unicycle(tmp_path: Path) -> None:
    pose = {"x": T, "y": T % 9, "yaw": T % 3}
    for columns in (
        pose | {"cmd_a": T, "cmd_b": T, "cmd_c": T},
        {"x": T, "y": T % 9, "cmd_a": T, "cmd_b": T},
        {"x": T, "z": T, "yaw": T % 3, "cmd_a": T, "cmd_b": T},
        {"x": T, "y": T % 9, "heading_x": T, "cmd_a": T, "cmd_b": T},
    ):
        assert Planar.of(logs(tmp_path, **columns)) is None


def test_commands_move_the_states_of_their_names_or_the_first(tmp_path: Path) -> None:
    slow, fast = np.cumsum(T % 5) / 10, np.cumsum(T % 3) / 10
    named = Direct.of(logs(tmp_path, load=T % 4, q2=slow, q1=fast, cmd_q1=T % 3, cmd_q2=T % 5))
    assert [field.short for field in named.moved] == ["q1", "q2"] and named.is_rate == (True, True)
    assert named.values()["indices"] == "[2, 1]"
    assert named.values()["step"] == "self.state + TIMESTEP_S * command"
    assert (named.values()["names"], named.values()["command"]) == ('("q1", "q2")', "[1.0, 1.0]")
    assert (named.values()["before"], named.values()["after"]) == ("[0.0, 1.0]", "[0.1, 1.1]")
    first = Direct.of(logs(tmp_path, vel_a=T % 4, a=slow, cmd_1=T % 5))
    assert [field.short for field in first.moved] == ["a"]
    assert (
        first.values()["names"] == '("a",)' and first.values()["lows"] == first.values()["highs"] == "[0.0]"
    )


def test_each_command_moves_a_state_of_its_own(tmp_path: Path) -> None:
    for columns, expected in (
        ({"a": T, "b": 2 * T, "cmd_1": T % 5, "cmd_2": T % 3}, ["a", "b"]),
        ({"x": T, "y": 2 * T, "cmd_uy": T % 5, "cmd_ux": T % 3}, ["y", "x"]),
        ({"a": T, "cmd_w_rad_s": T % 3}, ["a"]),  # in a unit that is not known
        ({"x_m": T, "cmd_1": T % 3}, ["x"]),
        ({"x": T, "z": 2 * T, "vx": T % 4, "vz": T % 5, "cmd_vx": T % 3, "cmd_vz": T % 2}, ["x", "z"]),
        ({"vx": T % 4, "cmd_vx": T % 3}, ["vx"]),  # of no position
    ):
        assert [field.short for field in Direct.of(logs(tmp_path, **columns)).moved] == expected


def test_states_are_moved_by_the_first_commands(tmp_path: Path) -> None:
    columns = {"x_m": T, "cmd_x_m_s": T % 3, "cmd_w_rad_s": T % 2}
    assert [field.short for field in Direct.of(logs(tmp_path, **columns)).moved] == ["x"]
    with pytest.raises(BadInputError, match="found no state that a command could move"):
        Direct.of(logs(tmp_path, x_m=T, cmd_w_rad_s=T % 2, cmd_x_m_s=T % 3))


def test_no_command_moves_a_state_of_another_unit(tmp_path: Path) -> None:
    columns = {"x_m": T, "y_m": T % 9, "tilt_rad": T % 3 / 9, "cmd_w_rad_s": T % 2, "cmd_v_m_s": T % 3}
    kind = Direct.of(logs(tmp_path, **columns))
    assert [field.short for field in kind.moved] == ["tilt", "x"]
    with pytest.raises(BadInputError, match="found no state that a command could move"):
        Direct.of(logs(tmp_path, x_m=T, cmd_w_rad_s=T % 2))


def test_a_turn_rate_moves_no_length_whatever_its_unit(tmp_path: Path) -> None:
    columns = {"x_m": T, "tilt": T % 3 / 9, "cmd_yaw_rate": T % 2, "cmd_v": T % 3}
    assert [field.short for field in Direct.of(logs(tmp_path, **columns)).moved] == ["tilt", "x"]


@pytest.mark.parametrize("stem", ["q", "quat_", "pose.orientation.", "imu_quaternion_"])
def test_no_command_moves_a_part_of_a_quaternion(tmp_path: Path, stem: str) -> None:
    parts = {f"{stem}{axis}": np.sin(T + number) for number, axis in enumerate("xyzw")}
    commands = {"cmd_vx": T % 5, "cmd_yaw_rate": T % 3, "cmd_vy": T % 2}
    kind = Direct.of(logs(tmp_path, x=T, y=T % 9, **parts, **commands))
    assert [field.short for field in kind.moved] == ["x"]
    names = [f"{stem}{axis}".replace(".", "_") for axis in "xyzw"]
    assert kind.simulator.endswith(f"x by vx; {', '.join(names)} are a quaternion: make yaw of it in φ")
    with pytest.raises(
        BadInputError, match=r"no state that a command could move: make yaw of the quaternion$"
    ):
        Direct.of(logs(tmp_path, **parts, **{f"cmd_{name}": values for name, values in parts.items()}))
    del parts[f"{stem}w"]  # three are none
    kind = Direct.of(logs(tmp_path, x=T, y=T % 9, **parts, **commands))
    assert [field.short for field in kind.moved] == ["x", names[0], "y"]
    assert "make yaw of it" not in kind.simulator
    pose = {"x": T, "y": T % 9, "z": T % 4, "w": T % 7}  # a position and a turn rate
    assert "make yaw of it" not in Direct.of(logs(tmp_path, **pose, **commands)).simulator


def test_speeds_along_a_vessel_that_move_its_place_are_told(tmp_path: Path) -> None:
    pose, swims = {"x": T, "y": T % 9, "z": T % 4, "yaw": T % 3 / 9}, {"cmd_surge": T % 5, "cmd_sway": T % 2}
    told = "; CHECK: surge and sway go along the robot: turn them by its heading"
    turns = {"cmd_heave": T % 7, "cmd_yaw_rate": T % 3}
    assert Direct.of(logs(tmp_path, **pose, **swims, **turns)).simulator.endswith(told)
    flies = {"cmd_vx": T % 5, "cmd_vy": T % 2}
    assert "CHECK" not in Direct.of(logs(tmp_path, **pose, **flies, **turns)).simulator
    speeds = {"surge": T % 5 / 2, "sway": T % 2 / 2}  # what is commanded, and no place
    assert "CHECK" not in Direct.of(logs(tmp_path, **pose, **speeds, **swims)).simulator


def test_commands_and_headings_that_a_simulator_leaves_out_are_told(tmp_path: Path) -> None:
    kind = Direct.of(logs(tmp_path, x_m=T, cmd_x_m_s=T % 3, cmd_w_rad_s=T % 2, cmd_u_rad_s=T % 5))
    assert kind.simulator == "CHECK: w and u have no effect; values that change as commanded: x by x"
    assert (kind.values()["effect"], kind.values()["outside"]) == ("; w and u have no effect", "")
    kind = Direct.of(logs(tmp_path, x_m=T, z_m=T % 9, yaw=T % 4, cmd_x_m_s=T % 3, cmd_z_m_s=T % 2))
    assert kind.simulator == "values that change as commanded: x by x, z by z; yaw is not in φ"
    assert (kind.values()["effect"], kind.values()["outside"]) == ("", ", in which yaw is not")


def test_speeds_are_no_position(tmp_path: Path) -> None:
    speeds = {"odom_linear_x": T % 7, "odom_linear_y": T % 4}
    kind = Planar.of(logs(tmp_path, **speeds, x=T, y=T % 9, yaw=T % 3, cmd_v=T % 5, cmd_w=T % 2))
    assert kind is not None and [field.short for field in kind.position] == ["x", "y"]


def test_names_with_dots_are_told_as_they_are() -> None:
    """As of a dataset, whose columns keep their names."""
    parts = [f"/imu:Orientation.{axis}" for axis in "xyzw"]
    states = ["lift.pos", *parts, "Mast:Yaw"]
    commands = ["Yaw.rate", "lift.pos"]
    fields = [Field(name, "state", name, "1", 1.0, "") for name in states]
    fields += [Field(f"cmd {name}", "command", name, "1", 1.0, "") for name in commands]
    values = {field.name: np.sin((number + 1) * T) for number, field in enumerate(fields)}
    kind = Direct.of(Logs(tuple(fields), (values,), {}))
    assert [field.short for field in kind.moved] == ["Mast:Yaw", "lift.pos"]
    assert kind.simulator.endswith(f"{', '.join(parts)} are a quaternion: make yaw of it in φ")


def test_positions_may_be_called_px_and_py(tmp_path: Path) -> None:
    kind = Planar.of(logs(tmp_path, px=T, py=T % 9, yaw=T % 3, cmd_v=T % 5, cmd_w=T % 2))
    assert kind is not None and [field.short for field in kind.position] == ["px", "py"]


def test_commands_may_be_where_to_be(tmp_path: Path) -> None:
    q = np.concatenate([[0.0], T[:-1] % 5])
    kind = Direct.of(logs(tmp_path, q1=q, cmd_q1=T % 5, cmd_q2=T % 3))
    assert kind.is_rate == (False,)
    assert kind.values()["step"] == "command[:, :1]" and kind.values()["after"] == "[1.0]"


def test_each_command_is_a_rate_or_a_target_by_itself(tmp_path: Path) -> None:
    speed, grip = np.sin(T), 90 * np.cos(T)  # errors of the grip alone would outweigh those of x
    x = np.concatenate([[0], np.cumsum(0.1 * speed)[:-1]])
    found = logs(tmp_path, x=x, grip=np.concatenate([[0], grip[:-1]]), cmd_vx=speed, cmd_grip=grip)
    kind = Direct.of(found)
    assert [field.short for field in kind.moved] == ["x", "grip"] and kind.is_rate == (True, False)
    assert kind.simulator == (
        "values that change as commanded: x by vx; "
        "values that are where they are put as commanded: grip by grip"
    )
    is_rate = "torch.tensor([True, False], device=command.device)"
    step = f"torch.where({is_rate}, self.state + TIMESTEP_S * command, command)"
    assert kind.values()["step"] == step
    assert (kind.values()["before"], kind.values()["after"]) == ("[0.0, 1.0]", "[0.1, 1.0]")


@pytest.mark.parametrize("is_rate", [True, False])
@pytest.mark.parametrize(("rows", "fast"), [(300, 0.3), (8, 0.9)])
def test_an_actuator_with_a_lag_is_told_from_one_of_speeds(
    tmp_path: Path, is_rate: bool, rows: int, fast: float
) -> None:
    walk = np.cumsum(np.random.default_rng(0).uniform(-0.1, 0.1, (rows, 2)), axis=0)
    command = np.random.default_rng(1).uniform(-3, 3, (rows, 2)).repeat(3, axis=0)[:rows] if is_rate else walk
    follows, q = np.zeros(2), [np.zeros(2)]
    for given in command[:-1]:
        follows = follows + fast * (given - follows)
        q.append(q[-1] + follows / 30 if is_rate else follows)
    time, (q0, q1), (cmd_q0, cmd_q1) = np.arange(rows) / 30, np.array(q).T, command.T
    kind = Direct.of(logs(tmp_path, time=time, q0=q0, q1=q1, cmd_q0=cmd_q0, cmd_q1=cmd_q1))
    assert kind.is_rate == (is_rate, is_rate)


def test_something_has_to_move(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="found no state that a command could move"):
        Direct.of(logs(tmp_path, vel_a=T % 4, cmd_1=T % 5))


def test_a_place_to_go_is_no_place_of_the_robot(tmp_path: Path) -> None:
    fixed = {"base_x": 3 + 0 * T, "base_y": 4 + 0 * T}
    for drive in range(2):
        columns = {name: values + drive for name, values in fixed.items()}
        columns |= {"x": T, "y": T % 9, "yaw": T % 3, "cmd_v": T % 5, "cmd_w": T % 2}
        table = np.column_stack([*columns.values()])
        np.savetxt(tmp_path / f"{drive}.csv", table, "%.6f", ",", header=",".join(columns), comments="")
    kind = Planar.of(guess([tmp_path]))
    assert kind is not None
    assert [field.short for field in kind.position] == ["x", "y"]


def test_where_episodes_end_as_they_began_near_is_a_tenth_of_the_farthest_way(tmp_path: Path) -> None:
    there_and_back = np.minimum(T, 49 - T)
    kind = Planar.of(logs(tmp_path, x=there_and_back, y=0 * T + 1, yaw=T % 3, cmd_v=T % 5, cmd_w=T % 2))
    assert kind is None  # y never changes, and is left out
    kind = Planar.of(logs(tmp_path, x=there_and_back, y=there_and_back, yaw=T % 3, cmd_v=T % 5, cmd_w=T % 2))
    assert kind is not None
    assert float(kind.values()["close"]) == pytest.approx(np.hypot(24, 24) / 10, rel=0.05)


def test_states_that_move_between_logs_alone_have_a_goal_of_some_size(tmp_path: Path) -> None:
    for number in range(2):
        table = np.column_stack([0 * T + 3 + number, T % 5])
        np.savetxt(tmp_path / f"{number}.csv", table, "%.6f", ",", header="x,cmd_x", comments="")
    kind = Direct.of(guess([tmp_path]))
    assert float(kind.values()["close"]) == pytest.approx(0.1)


def test_a_heading_is_an_angle_as_it_is_unless_it_goes_round(tmp_path: Path) -> None:
    turned = np.cumsum(T % 5 / 10) - T % 5 / 10
    for yaw, template in ((turned / 4, "direct.py"), (turned, "turning.py"), (turned % 6, "turning.py")):
        kind = Direct.of(logs(tmp_path, z=T, yaw=yaw, cmd_vz=T % 3, cmd_yaw_rate=T % 5))
        assert [field.short for field in kind.moved] == ["z", "yaw"] and kind.template == template
    for name in ("yaw_m", "mast_angle"):  # no angle, and no heading
        kind = Direct.of(logs(tmp_path, **{name: turned}, cmd_a=T % 5))
        assert kind.template == "direct.py"


def test_cosine_and_sine_of_a_heading_have_one_range(tmp_path: Path) -> None:
    off = 0.2 * np.sin(T)  # from where it wraps: 0.02 of the cosine, 0.4 of the sine
    wrapped = np.arctan2(-np.sin(off), -np.cos(off))
    values = Direct.of(logs(tmp_path, z=T, yaw=wrapped, cmd_z=T, cmd_yaw=wrapped)).values()
    assert values["names"] == '("z", "yaw_x", "yaw_y")'
    assert (values["step"], values["apart"]) == ("command", "")  # no heading is stepped from where it was
    z, cosine, sine = (float(value) for value in values["range"].strip("()").split(","))
    assert z == 49 and cosine == sine == pytest.approx(2 * np.sin(0.2), rel=1e-3)


def test_a_turn_rate_moves_the_heading_of_its_name_before_others(tmp_path: Path) -> None:
    turned = np.cumsum(T % 3) / 10
    kind = Direct.of(logs(tmp_path, theta=turned, yaw=2 + turned, cmd_vyaw=T % 3))
    assert [field.short for field in kind.moved] == ["yaw"]
