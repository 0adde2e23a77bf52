"""The example of a ROS 2 node, with the parts of ROS 2 that it uses played."""

import json
import runpy
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

EXAMPLE = Path(__file__).parents[2] / "recipes/examples/ros2/drive.py"
POLICY = """
class RobotPolicy:
    def __init__(self, *, rate_hz, state, goal):
        self.names, self.about, self.begun, self.acted = (state, goal), {"rate_hz": rate_hz}, 0, []

    def start(self):
        self.begun += 1

    def act(self, state, goal):
        self.acted.append((state, goal))
        if state[0] > 9:
            raise ValueError("the policy gives no command")
        return [0.1 * len(self.acted), -0.5]
"""


class Node:
    """Of ROS, as far as the example uses it: `ros` calls what it asks for."""

    ros: "Ros"

    def __init__(self, name: str) -> None:
        self.ros.node = self

    def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
        assert (kind.__name__, topic) == ("Twist", "cmd_vel")
        return SimpleNamespace(publish=self.ros.publish)

    def create_subscription(
        self, kind: type, topic: str, hear: Callable[[object], None], quality: dict[str, object]
    ) -> None:
        assert (kind.__name__, topic, quality["depth"]) == ("Odometry", "odom", 1)
        self.ros.hear = hear

    def create_timer(self, period_s: float, step: Callable[[], None]) -> None:
        self.ros.rate_hz, self.ros.step = 1 / period_s, step

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(warning=self.ros.warned.append)


class Twist:
    def __init__(self) -> None:
        self.linear, self.angular = SimpleNamespace(x=0.0), SimpleNamespace(z=0.0)


class Ros:
    """Stands for rclpy; `events` happens, one part in each call of `spin_once`."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, float]] = []
        self.warned: list[str] = []
        self.now, self.rate_hz, self.is_up = 100.0, 0.0, False
        self.node: Any = None
        self.hear: Callable[[object], None]
        self.step: Callable[[], None]
        self.events: Iterator[None]

    def modules(self) -> dict[str, ModuleType]:
        parts: dict[str, dict[str, Any]] = {
            "rclpy": {"init": self.init, "spin_once": self.spin_once, "shutdown": self.shutdown},
            "rclpy.node": {"Node": type("Node", (Node,), {"ros": self})},
            "rclpy.qos": {"QoSProfile": dict, "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT=2)},
            "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO=0)},
            "rclpy.utilities": {"remove_ros_args": lambda given: given[: given.index("--ros-args")]},
            "geometry_msgs": {},
            "geometry_msgs.msg": {"Twist": Twist, "TwistStamped": object},
            "nav_msgs": {},
            "nav_msgs.msg": {"Odometry": type("Odometry", (), {})},
        }
        found = {name: ModuleType(name) for name in parts}
        for name, values in parts.items():
            vars(found[name]).update(values)
        return found

    def init(self, *, args: list[str], signal_handler_options: int) -> None:
        assert args[-1] == "odom:=odometry" and signal_handler_options == 0
        self.is_up = True

    def spin_once(self, node: object) -> None:
        assert node is self.node
        next(self.events)

    def shutdown(self) -> None:
        self.is_up = False

    def publish(self, sent: Twist) -> None:
        assert self.is_up, "the publisher's context is invalid"
        self.sent.append((sent.linear.x, sent.angular.z))

    def odometry(self, x: float) -> None:
        position, orientation = SimpleNamespace(x=x, y=2.0), SimpleNamespace(x=0.0, y=0.0, z=0.6, w=0.8)
        pose = SimpleNamespace(pose=SimpleNamespace(position=position, orientation=orientation))
        twist = SimpleNamespace(linear=SimpleNamespace(x=0.3), angular=SimpleNamespace(z=0.4))
        self.hear(SimpleNamespace(pose=pose, twist=SimpleNamespace(twist=twist)))


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    ros = Ros()
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "run_policy", raising=False)
    monkeypatch.setattr("time.monotonic", lambda: ros.now)
    monkeypatch.setattr("time.sleep", lambda _: None)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield ros
    sys.modules.pop("run_policy", None)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "run_policy.py").write_text(POLICY)
    (tmp_path / "policy.json").write_text(json.dumps({"rate_hz": 10.0, "goal": {"names": ["gx", "gy"]}}))
    return tmp_path


def drive(*asked: object) -> None:
    module = runpy.run_path(str(EXAMPLE))
    module["main"](["drive.py", *map(str, asked), "--ros-args", "-r", "odom:=odometry"])


def test_it_drives_by_odometry_and_stops_without(ros: Ros, folder: Path) -> None:
    def events() -> Iterator[None]:
        ros.step()  # nothing was heard yet
        ros.odometry(1.0)
        yield ros.step()
        ros.now += 0.15
        yield ros.step()  # the same odometry is fresh enough
        ros.now += 0.1
        yield ros.step()  # and now stale
        yield ros.step()
        ros.odometry(1.5)
        yield ros.step()
        raise KeyboardInterrupt

    ros.events = events()
    drive(folder, 3, -1)
    policy = ros.node.policy
    imported = tomllib.loads((EXAMPLE.parents[2] / "imports/ros2_base.toml").read_text())
    assert [*policy.names[0]] == imported["columns"]["observation.state"]["names"]
    assert policy.names[1] == ["gx", "gy"] and ros.rate_hz == pytest.approx(10.0)
    driven = [(0.1, -0.5), (0.2, -0.5), (0.0, 0.0), (0.0, 0.0), (pytest.approx(0.3), -0.5)]
    assert ros.sent == [(0.0, 0.0), *driven, (0.0, 0.0)]  # a stop comes last
    assert policy.begun == 2 and ros.warned == ["no odometry for 0.2 s: the robot is stopped"]
    assert policy.acted[0] == ((1.0, 2.0, 0.6, 0.8, 0.3, 0.4), [3.0, -1.0]) and policy.acted[2][0][0] == 1.5
    assert not ros.is_up


def test_a_drive_ends_and_an_error_stops_the_robot(ros: Ros, folder: Path) -> None:
    def events(x: float) -> Iterator[None]:
        while True:
            ros.odometry(x)
            yield ros.step()
            ros.now += 7.0

    ros.events = events(1.0)
    drive(folder, 3, -1)
    assert len(ros.node.policy.acted) == 9  # in 60 s
    assert ros.sent[-1] == (0.0, 0.0) and not ros.is_up
    ros.events = events(10.0)
    with pytest.raises(ValueError, match="the policy gives no command"):
        drive(folder, 3, -1)
    assert ros.sent[-1] == (0.0, 0.0) and not ros.is_up


def test_a_drive_whose_odometry_stays_out_ends_as_well(ros: Ros, folder: Path) -> None:
    def events() -> Iterator[None]:
        ros.odometry(1.0)
        for _ in range(20):
            yield ros.step()
            ros.now += 7.0
        raise AssertionError("still driving after 140 s")

    ros.events = events()
    drive(folder, 3, -1)
    assert ros.sent == [(0.1, -0.5), *[(0.0, 0.0)] * 9] and not ros.is_up


def test_what_is_asked_wrongly_is_told_before_anything_moves(
    ros: Ros, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for asked, told in (
        ((folder, 3), "expected a value for each of ['gx', 'gy'], got [3.0]"),
        ((folder / "other", 3, -1), "other is no folder that astra-data deploy wrote"),
        ((), "the following arguments are required: policy"),
    ):
        with pytest.raises(SystemExit):
            drive(*asked)
        assert told in capsys.readouterr().err
    assert ros.node is None
