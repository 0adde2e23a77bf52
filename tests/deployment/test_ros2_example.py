"""The example of a ROS 2 node, with the parts of ROS 2 that it uses played."""

import json
import runpy
import sys
import tomllib
from collections.abc import Callable
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
        if len(self.acted) == 4:
            raise ValueError("the policy gives no command")
        return [0.1 * len(self.acted), -0.5]
"""


class Ros:
    """Stands for rclpy: the node's timer and subscription are called by the test."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, float]] = []
        self.warned: list[str] = []
        self.now, self.rate_hz = 100.0, 0.0
        self.node: Any = None
        self.hear: Callable[[object], None]
        self.step: Callable[[], None]

    def modules(self) -> dict[str, ModuleType]:
        ros = self

        class Node:
            def __init__(self, name: str) -> None:
                ros.node = self

            def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
                assert topic == "/cmd_vel"
                return SimpleNamespace(publish=lambda sent: ros.sent.append((sent.linear.x, sent.angular.z)))

            def create_subscription(
                self, kind: type, topic: str, hear: Callable[[object], None], quality: object
            ) -> None:
                assert (kind.__name__, topic) == ("Odometry", "/odom")
                ros.hear = hear

            def create_timer(self, period_s: float, step: Callable[[], None]) -> None:
                ros.rate_hz, ros.step = 1 / period_s, step

            def get_logger(self) -> SimpleNamespace:
                return SimpleNamespace(warning=ros.warned.append)

        class Twist:
            def __init__(self) -> None:
                self.linear, self.angular = SimpleNamespace(x=0.0), SimpleNamespace(z=0.0)

        parts: dict[str, dict[str, Any]] = {
            "rclpy": {"init": lambda: None, "spin": self.spin},
            "rclpy.node": {"Node": Node},
            "rclpy.qos": {"qos_profile_sensor_data": object()},
            "geometry_msgs": {},
            "geometry_msgs.msg": {"Twist": Twist},
            "nav_msgs": {},
            "nav_msgs.msg": {"Odometry": type("Odometry", (), {})},
        }
        found = {name: ModuleType(name) for name in parts}
        for name, values in parts.items():
            vars(found[name]).update(values)
        return found

    def odometry(self, x: float) -> None:
        position, orientation = SimpleNamespace(x=x, y=2.0), SimpleNamespace(x=0.0, y=0.0, z=0.6, w=0.8)
        pose = SimpleNamespace(pose=SimpleNamespace(position=position, orientation=orientation))
        twist = SimpleNamespace(linear=SimpleNamespace(x=0.3), angular=SimpleNamespace(z=0.4))
        self.hear(SimpleNamespace(pose=pose, twist=SimpleNamespace(twist=twist)))

    def spin(self, node: object) -> None:
        assert node is self.node
        self.step()  # nothing was heard yet
        self.odometry(1.0)
        self.step()
        self.now += 0.15
        self.step()  # the same odometry is fresh enough
        self.now += 0.1
        self.step()  # and now stale
        self.step()
        self.odometry(1.5)
        self.step()
        self.step()


def test_it_drives_by_odometry_and_stops_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ros = Ros()
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr("time.monotonic", lambda: ros.now)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "run_policy.py").write_text(POLICY)
    (tmp_path / "policy.json").write_text(json.dumps({"rate_hz": 10.0, "goal": {"names": ["gx", "gy"]}}))
    with pytest.raises(ValueError, match="the policy gives no command"):
        runpy.run_path(str(EXAMPLE))["main"](str(tmp_path), "3", "-1")
    policy = ros.node.policy
    monkeypatch.delitem(sys.modules, "run_policy")
    imported = tomllib.loads((EXAMPLE.parents[2] / "imports/ros2_base.toml").read_text())
    assert [*policy.names[0]] == imported["columns"]["observation.state"]["names"]
    assert policy.names[1] == ["gx", "gy"]
    assert ros.rate_hz == pytest.approx(10.0)
    assert ros.sent == [
        (0.0, 0.0),
        (0.1, -0.5),
        (0.2, -0.5),
        (0.0, 0.0),
        (0.0, 0.0),
        (pytest.approx(0.3), -0.5),
        (0.0, 0.0),  # after the error
    ]
    assert policy.begun == 2 and ros.warned == ["no odometry for 0.2 s: the robot is stopped"]
    assert policy.acted[0] == ((1.0, 2.0, 0.6, 0.8, 0.3, 0.4), [3.0, -1.0])
    assert policy.acted[2][0][0] == 1.5
