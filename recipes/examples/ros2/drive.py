"""A deployed policy as a ROS 2 node: `python drive.py POLICY [GOAL ...]`, in a shell that has sourced ROS 2.

It hears odom, with the values that recipes/imports/ros2_base.toml imports, and commands speed and turn rate
on cmd_vel. Where odometry stays out it commands a stop, and begins anew when it is back; its last command is
a stop, too. POLICY is a folder that `astra-data deploy` wrote. `--ros-args` renames topics.
"""

import argparse
import json
import signal
import sys
import time
from pathlib import Path

import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

STATE = ("x", "y", "orientation_z", "orientation_w", "v", "w")
STAMPED = False  # CHECK: whether the base hears TwistStamped, as many do from Jazzy on
STALE_S = 0.2  # CHECK: older odometry is none
LASTS_S = 60.0  # CHECK: a drive ends after so long


def reached(state, goal):  # CHECK: where a drive ends; policies are not trained beyond the goal
    """Return whether the robot is there."""
    return False


def state_of(odometry):
    """Return the values of STATE."""
    pose, twist = odometry.pose.pose, odometry.twist.twist
    place = (pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w)
    return (*place, twist.linear.x, twist.angular.z)


class Driver(Node):
    """Acts once every control period, until the robot is there or time is out."""

    def __init__(self, policy, goal):
        super().__init__("astra_data_policy")
        self.policy, self.goal = policy, goal
        self.state, self.heard_s, self.drives, self.is_over = None, 0.0, False, False
        self.ends_s = time.monotonic() + LASTS_S
        self.commands = self.create_publisher(TwistStamped if STAMPED else Twist, "cmd_vel", 1)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(Odometry, "odom", self.hear, newest)
        self.create_timer(1.0 / policy.about["rate_hz"], self.step)

    def hear(self, odometry):
        self.state, self.heard_s = state_of(odometry), time.monotonic()

    def step(self):
        if time.monotonic() > self.ends_s:
            self.is_over = True
        elif self.state is None or time.monotonic() - self.heard_s > STALE_S:
            self.send(0.0, 0.0)
            if self.drives:
                self.get_logger().warning(f"no odometry for {STALE_S} s: the robot is stopped")
            self.drives = False
        elif reached(self.state, self.goal):
            self.is_over = True
        else:
            if not self.drives:
                self.policy.start()  # an episode begins
            self.drives = True
            self.send(*map(float, self.policy.act(self.state, self.goal)))

    def send(self, speed, turn):
        command = TwistStamped() if STAMPED else Twist()
        if STAMPED:
            command.header.stamp = self.get_clock().now().to_msg()
        twist = command.twist if STAMPED else command
        twist.linear.x, twist.angular.z = speed, turn
        self.commands.publish(command)


def main(arguments):
    parser = argparse.ArgumentParser(description="Drive a robot by a deployed policy.")
    parser.add_argument("policy", type=Path, help="a folder that astra-data deploy wrote")
    parser.add_argument("goal", nargs="*", type=float, help="where to go, if the policy takes a goal")
    asked = parser.parse_args(remove_ros_args(arguments)[1:])
    if not (asked.policy / "policy.json").is_file():
        parser.error(f"{asked.policy} is no folder that astra-data deploy wrote")
    about = json.loads((asked.policy / "policy.json").read_text())
    if len(asked.goal) != len(about["goal"]["names"]):
        parser.error(f"expected a value for each of {about['goal']['names']}, got {asked.goal}")
    sys.path.append(str(asked.policy))
    from run_policy import RobotPolicy  # noqa: PLC0415 - it is in the folder

    policy = RobotPolicy(rate_hz=about["rate_hz"], state=STATE, goal=about["goal"]["names"])
    # Handlers of rclpy would end its context before the last command is out.
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    driver = Driver(policy, asked.goal)
    try:
        while not driver.is_over:
            rclpy.spin_once(driver)
    except KeyboardInterrupt:
        pass
    finally:
        driver.send(0.0, 0.0)  # the base needs a watchdog all the same
        time.sleep(0.2)  # until it is out
        rclpy.shutdown()


if __name__ == "__main__":
    main(sys.argv)
