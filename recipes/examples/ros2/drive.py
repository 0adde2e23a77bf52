"""A deployed policy as a ROS 2 node: `python drive.py POLICY [GOAL ...]`, in a shell that has sourced ROS 2.

It hears /odom, with the values that recipes/imports/ros2_base.toml imports, and commands speed and turn rate
on /cmd_vel. Where odometry stays out it commands a stop, and begins anew when it is back. POLICY is a folder
that `astra-data deploy` wrote.
"""

import json
import sys
import time
from pathlib import Path

import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

STATE = ("x", "y", "orientation_z", "orientation_w", "v", "w")
STALE_S = 0.2  # CHECK: older odometry is none


def state_of(odometry):
    """Return the values of STATE."""
    pose, twist = odometry.pose.pose, odometry.twist.twist
    place = (pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w)
    return (*place, twist.linear.x, twist.angular.z)


class Driver(Node):
    """Acts once every control period."""

    def __init__(self, policy, goal):
        super().__init__("astra_data_policy")
        self.policy, self.goal = policy, goal
        self.state, self.heard_s, self.drives = None, 0.0, False
        self.commands = self.create_publisher(Twist, "/cmd_vel", 1)
        self.create_subscription(Odometry, "/odom", self.hear, qos_profile_sensor_data)
        self.create_timer(1.0 / policy.about["rate_hz"], self.step)

    def hear(self, odometry):
        self.state, self.heard_s = state_of(odometry), time.monotonic()

    def step(self):
        if self.state is None or time.monotonic() - self.heard_s > STALE_S:
            self.send(0.0, 0.0)
            if self.drives:
                self.get_logger().warning(f"no odometry for {STALE_S} s: the robot is stopped")
            self.drives = False
            return
        if not self.drives:
            self.policy.start()  # an episode begins
        self.drives = True
        self.send(*map(float, self.policy.act(self.state, self.goal)))

    def send(self, speed, turn):
        command = Twist()
        command.linear.x, command.angular.z = speed, turn
        self.commands.publish(command)


def main(folder, *goal):
    sys.path.append(folder)
    from run_policy import RobotPolicy  # noqa: PLC0415 - it is in the folder

    about = json.loads((Path(folder) / "policy.json").read_text())
    policy = RobotPolicy(rate_hz=about["rate_hz"], state=STATE, goal=about["goal"]["names"])
    rclpy.init()
    driver = Driver(policy, [float(value) for value in goal])
    try:
        rclpy.spin(driver)
    finally:
        driver.send(0.0, 0.0)  # also after an error, and after Ctrl-C; the base needs a watchdog all the same


if __name__ == "__main__":
    main(*sys.argv[1:])
