import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import Writer as McapWriter
from mcap_recordings import MAPPING, command, log, ns, pose, write_json, write_protobuf, write_ros2
from mcap_ros2.writer import Writer
from recordings import imported

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, STATE
from astra_data.dataset.reader import Dataset
from astra_data.io.importers.mcap import MessageField
from astra_data.io.importing import import_dataset


@pytest.mark.parametrize("write", [write_json, write_protobuf, write_ros2])
def test_the_last_value_is_held_at_every_row(tmp_path: Path, write: Any) -> None:
    messages = log()
    dataset, report = imported(tmp_path, write(tmp_path / "log.mcap", messages), MAPPING)
    poses = [(t, m["position"]["x"]) for topic, t, m in messages if topic == "/pose"]
    turns = [(t, m["turn"]) for topic, t, m in messages if topic == "/command"]
    assert len(dataset) == 2 and report.tally.split_points == {"source": 1}
    first, second = dataset.episodes()
    # From the first command to when the pose of 2 s may be held no longer, and from the pose of 3 s on.
    ends = ((0.13, 2.35), (3.0, 4.96))
    for episode, (start, end) in zip((first, second), ends, strict=True):
        ticks = [ns(start) + k * 10**8 for k in range(1000) if ns(start) + k * 10**8 <= ns(end)][:-1]
        x = [[v for t, v in poses if ns(t) <= tick][-1] for tick in ticks]
        expected = np.stack([x, np.add(x, 0.25), np.negative(x)], axis=1).astype(np.float32)
        np.testing.assert_array_equal(episode.columns[STATE], expected)
        turn = [[v for t, v in turns if ns(t) <= tick][-1] for tick in ticks]
        np.testing.assert_array_equal(episode.columns[ACTION], np.array(turn, np.float32))


def test_a_latched_topic_is_held_without_limit(tmp_path: Path) -> None:
    messages = [command(0.0, 7.0), *(pose(k / 10, k) for k in range(20))]
    path = write_json(tmp_path / "log.mcap", messages)
    latched = MAPPING.replace('fields = ["/command:turn"]', 'fields = ["/command:turn"]\nlatched = true')
    dataset, _ = imported(tmp_path, path, latched)
    np.testing.assert_array_equal(dataset.columns([ACTION])[ACTION], np.full(19, 7, np.float32))
    (tmp_path / "held").mkdir()
    held, _ = imported(tmp_path / "held", path, MAPPING)
    assert held.lengths.tolist() == [3]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("/command:turn", "/comand:turn"), r"no topic '/comand': did you mean '/command'"),
        (("/pose:joints", "joints"), "'joints', expected '/topic:path.in.message'"),
        (("gap_s = 0.35", ""), "split.gap_s is missing"),
        (("fps = 10", 'fps = 10\ntime = "/pose:t"'), "time: leave it out"),
    ],
)
def test_a_wrong_mapping_is_told(tmp_path: Path, change: tuple[str, str], told: str) -> None:
    path = write_json(tmp_path / "log.mcap", log())
    with pytest.raises(BadInputError, match=told):
        imported(tmp_path, path, MAPPING.replace(*change))
    assert not (tmp_path / "out").exists()


def test_messages_that_change_in_size_are_told(tmp_path: Path) -> None:
    messages = [command(0, 0), pose(0, 0), ("/pose", 0.1, {"position": {"x": 0}, "joints": [1.0]})]
    with pytest.raises(BadInputError, match="/pose:joints changes in size"):
        imported(tmp_path, write_json(tmp_path / "log.mcap", messages), MAPPING)


ODOMETRY = """std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
"""
PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
}
"""The messages of ROS 2 that odometry is made of."""


def definition(text: str, *parts: str) -> str:
    return text + "".join(f"\n{'=' * 80}\nMSG: {name}\n{PARTS[name]}\n" for name in parts)


def test_the_bag_of_a_wheeled_base_is_read_by_the_mapping_that_comes_with_the_package(tmp_path: Path) -> None:
    """A circle of 1 m at 0.5 m/s, odometry at 50 Hz and commands at 10 Hz."""
    with (tmp_path / "drive.mcap").open("wb") as file:
        writer = Writer(file)
        odometry = writer.register_msgdef("nav_msgs/Odometry", definition(ODOMETRY, *PARTS))
        twist = definition(PARTS["geometry_msgs/Twist"], "geometry_msgs/Vector3")
        command = writer.register_msgdef("geometry_msgs/Twist", twist)
        nothing = {"x": 0.0, "y": 0.0, "z": 0.0}
        for tick in range(250):
            time, heading = tick / 50, 0.5 * tick / 50
            place = {"x": np.sin(heading), "y": 1 - np.cos(heading), "z": 0.0}
            turned = {"x": 0.0, "y": 0.0, "z": np.sin(heading / 2), "w": np.cos(heading / 2)}
            speed = {"linear": nothing | {"x": 0.5}, "angular": nothing | {"z": 0.5}}
            content = {
                "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "odom"},
                "child_frame_id": "base_link",
                "pose": {"pose": {"position": place, "orientation": turned}, "covariance": [0.0] * 36},
                "twist": {"twist": speed, "covariance": [0.0] * 36},
            }
            writer.write_message("/odom", odometry, content, ns(time))
            if tick % 5 == 0:
                writer.write_message("/cmd_vel", command, speed, ns(time))
        writer.finish()  # type: ignore[no-untyped-call]
    mapping = Path(__file__).parents[3] / "recipes/imports/ros2_base.toml"
    report = import_dataset([tmp_path / "drive.mcap"], mapping, out=tmp_path / "set")
    [episode] = Dataset.open(report.root).episodes()
    state = episode.columns[STATE]
    yaw = 2 * np.arctan2(state[:, 2], state[:, 3])
    assert len(episode) == 49
    np.testing.assert_allclose(yaw, 0.05 * np.arange(49), atol=0.011)
    np.testing.assert_allclose(state[:, 0], np.sin(yaw), atol=1e-6)
    assert episode.columns[ACTION].tolist() == [[0.5, 0.5]] * 49


def test_a_pause_of_all_topics_ends_the_episode_with_its_last_message(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """No row is made up, and nobody is blamed for being silent."""
    drives = [m for t in (0.0, 60.0) for k in range(5) for m in (pose(t + k / 10, k), command(t + k / 10, k))]
    dataset, report = imported(tmp_path, write_json(tmp_path / "log.mcap", drives), MAPPING)
    assert dataset.lengths.tolist() == [4, 4] and report.tally.rows == 10
    assert dataset.columns([ACTION])[ACTION].tolist() == [0.0, 1.0, 2.0, 3.0] * 2 and not caplog.messages


def test_a_topic_that_alone_is_silent_is_named_with_the_remedy(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    messages = [pose(k / 10, k) for k in range(40)] + [command(t, 1.0) for t in (0.0, 1.0, 1.2, 2.5)]
    path = write_json(tmp_path / "log.mcap", sorted(messages, key=lambda message: message[1]))
    imported(tmp_path, path, MAPPING)
    [warning] = caplog.messages
    assert "log.mcap: /command is silent for over 0.35 s (split.gap_s) 3 times while others are not" in warning
    assert "latched = true" in warning and "That is right if the robot stops by itself" in warning


def drive(begin: float, end: float) -> list[tuple[str, float, dict[str, Any]]]:
    return [m for k in range(round(10 * begin), round(10 * end)) for m in (pose(k / 10, k), command(k / 10 + 0.02, k))]


def test_where_a_clock_is_set_back_an_episode_begins_and_is_counted(tmp_path: Path) -> None:
    """Before, both stretches were one, with their rows in turn."""
    back = [(topic, time - 2, content) for topic, time, content in drive(3, 6)]
    dataset, report = imported(tmp_path, write_json(tmp_path / "log.mcap", drive(0, 3) + back), MAPPING)
    assert report.tally.split_points == {"source": 1}
    values = dataset.columns([STATE, ACTION])
    assert dataset.lengths.tolist() == [29, 29]
    assert values[ACTION].tolist() == values[STATE][:, 0].tolist() == [*range(29), *range(30, 59)]


def test_a_bag_that_is_cut_off_is_read_up_to_there_and_counted(tmp_path: Path) -> None:
    whole, cut = tmp_path / "0.mcap", tmp_path / "1.mcap"
    for path in (whole, cut):
        with path.open("wb") as file:
            writer = McapWriter(file, chunk_size=400)
            writer.start()
            channels = {topic: writer.register_channel(topic, "json", schema_id=0) for topic in ("/pose", "/command")}
            for topic, time, content in drive(0, 3):
                writer.add_message(channels[topic], ns(time), json.dumps(content).encode(), ns(time))
            writer.finish()  # type: ignore[no-untyped-call]
    written = cut.read_bytes()
    cut.write_bytes(written[: len(written) // 3])
    dataset, report = imported(tmp_path, [whole, cut], MAPPING)
    first, second = dataset.episodes()
    assert len(first) == 29 and 5 < len(second) < 20
    np.testing.assert_array_equal(second.columns[STATE], first.columns[STATE][: len(second)])
    assert report.tally.torn_rows == report.tally.rejected_rows == 1
    told = f"rejected rows: 1; cut off at the end of their files: 1, the first is 1.mcap row {len(second) + 1}"
    assert told in str(report)
    cut.write_bytes(written[:-1])
    assert import_dataset([cut], tmp_path / "mapping.toml", out=tmp_path / "all").tally.torn_rows == 0


def test_all_bags_that_lack_something_are_told_at_once(tmp_path: Path) -> None:
    """As far as their indexes tell."""
    lacking = [m for m in log() if m[0] == "/pose"]
    bags = [write_json(tmp_path / f"{name}.mcap", lacking if name in "12" else log()) for name in "102"]
    with pytest.raises(BadInputError) as caught:
        imported(tmp_path, bags, MAPPING)
    assert str(caught.value) == "1.mcap, 2.mcap: no topic '/command'; known: /pose"


def test_the_parts_of_a_split_bag_are_not_joined_without_a_word(tmp_path: Path) -> None:
    messages = log()
    folder = tmp_path / "bag"
    folder.mkdir()
    for number, part in enumerate((messages[:40], messages[40:])):
        write_json(folder / f"bag_{number}.mcap", part)
    joined = f"{MAPPING}files = false\n"
    with pytest.raises(BadInputError, match=r"bag: split.files = false cannot join its 2 MCAP files, .*ros2 bag conv"):
        imported(tmp_path, folder, joined)
    _, report = imported(tmp_path, folder, MAPPING)
    assert report.tally.split_points == {"file": 1, "source": 1}
    for number in range(2):  # a file is all of its recording
        imported(tmp_path / str(number), folder / f"bag_{number}.mcap", joined)


def joints(time: float, **positions: float) -> tuple[str, float, dict[str, Any]]:
    return "/joints", time, {"name": list(positions), "position": list(positions.values()), "stamp": time}


@pytest.mark.parametrize("shared", [False, True])
def test_publishers_of_one_topic_are_held_apart(tmp_path: Path, shared: bool) -> None:
    """An arm at 20 Hz and a gripper at 5 Hz; `shared`: the gripper's driver sends a joint of the arm, too."""
    messages = [joints(k / 20, b=-k, a=k) for k in range(101)]
    more = {"a": -1.0} if shared else {}
    messages += [joints(k / 5 + 0.011, grip=10 * k, **more) for k in range(26)]
    messages += [command(k / 10, k) for k in range(51)]
    path = write_json(tmp_path / "log.mcap", sorted(messages, key=lambda message: message[1]))
    mapping = MAPPING.replace(
        '["/pose:position.x", "/pose:joints"]',
        '["/joints:position[a]", "/joints:position[b]", "/joints:position[grip]"]',
    )
    dataset, _ = imported(tmp_path, path, mapping)
    [episode] = dataset.episodes()
    a, b, grip = episode.columns["observation.state"].T
    assert len(episode) == 50
    assert set(np.diff(b)) == {-2} and set(np.unique(grip) % 10) == {0} and (np.diff(grip) >= 0).all()
    assert (-1 in a) == shared
    if not shared:
        np.testing.assert_array_equal(a, -b)
    alone, _ = imported(tmp_path / "arm", path, mapping.replace(', "/joints:position[grip]"', ""))
    assert alone.schema[0].size == 2
    with pytest.raises(BadInputError, match=r"no 'thumb' in /joints:position"):
        imported(tmp_path / "none", path, mapping.replace("[grip]", "[thumb]"))


def named(names: list[str], velocity: list[float]) -> dict[str, Any]:
    return {"name": names, "velocity": velocity}


TWIST = {"linear": {"x": 0.5, "y": 0.0, "z": 0.0}}
STAMPED = {"header": {"stamp": {"sec": 1_764_000_000, "nanosec": 123_456_789}}}


@pytest.mark.parametrize(
    ("field", "content", "expected"),
    [
        ("/cmd_vel:linear.x", TWIST, 0.5),
        ("/joints:velocity", named(["a", "b"], [1.0, 2.0]), [1.0, 2.0]),
        ("/joints:velocity.1", named(["a", "b"], [1.0, 2.0]), 2.0),
        ("/joints:velocity[b]", named(["a", "b"], [1.0, 2.0]), 2.0),
        ("/joints:velocity[arm/b.1]", named(["arm/b.1", "b"], [1.0, 2.0]), 1.0),
        ("/joints:arms.0.velocity[b]", {"arms": [named(["a", "b"], [1.0, 2.0])]}, 2.0),
        ("/odom:header.stamp.sec", STAMPED, 1_764_000_000),
        ("/mode:name", {"name": "walk"}, "walk"),
    ],
)
def test_a_path_leads_to_a_value(field: str, content: Any, expected: Any) -> None:
    np.testing.assert_array_equal(MessageField(field).value(content), expected)


@pytest.mark.parametrize(
    ("field", "content", "fault"),
    [
        ("/cmd_vel:linear.xx", TWIST, "no part 'xx' in /cmd_vel:linear, which has x, y, z: did you mean 'x'?"),
        (
            "/clock:secs",
            Timestamp(seconds=1),
            "no part 'secs' in /clock, which has seconds, nanos: did you mean 'seconds'?",
        ),
        (
            "/joints:velocity.2",
            named(["a"], [1.0]),
            "no part '2' in /joints:velocity, which has 1 values, counted from 0",
        ),
        (
            "/joints:velocity[left_weel]",
            named(["left_wheel"], [1.0]),
            "no 'left_weel' in /joints:velocity: did you mean 'left_wheel'?",
        ),
        ("/cmd_vel:linear", TWIST, "'/cmd_vel:linear' is neither a number nor a list of numbers"),
    ],
)
def test_what_a_message_lacks_is_told_with_what_it_has(field: str, content: Any, fault: str) -> None:
    with pytest.raises(BadInputError) as error:
        MessageField(field).value(content)
    assert str(error.value) == fault


@pytest.mark.parametrize(("field", "left"), [("velocity[left]", 1.0), ("velocity", None), ("velocity.0", None)])
def test_joints_in_another_order_are_told_apart_by_name_alone(field: str, left: float | None) -> None:
    of_joint = MessageField(f"/joints:{field}")
    of_joint.value(named(["left", "right"], [1.0, 2.0]))
    of_joint.value(named(["left", "right"], [3.0, 4.0]))
    swapped = named(["right", "left"], [2.0, 1.0])
    if left is not None:
        assert float(of_joint.value(swapped)) == left
        return
    with pytest.raises(BadInputError) as error:
        of_joint.value(swapped)
    assert str(error.value) == (
        f"'/joints:{field}' is in another order than before: its names are right, left, and were left, "
        "right; take each value by its name, '/joints:velocity[left]'"
    )
