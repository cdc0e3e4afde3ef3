"""The node of a TurtleBot3, which behaves as `turtlebot3_node` and the lidar driver of ROS Jazzy.

`turtlebot3` starts it, and communicates with it over a socket. Names, frames, rates, QoS and units
are those of the originals, including their oddities. Speeds are truncated to hundredths. A command
is kept for ever. Battery percentages go up to 100. Joint velocities are those of the rims [m/s].
The odometry step in which the heading passes half a turn goes backwards. Nothing has a covariance.
"""

import json
import math
import os
import socket
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import rclpy
from geometry_msgs.msg import Quaternion, TransformStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import BatteryState, Imu, JointState, LaserScan
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from tests.ros2.programs.console import profile

SENSORS_S, HEARTBEAT_S, POLL_S = 0.05, 0.1, 0.005
WHEEL_RADIUS_M = 0.033
EMPTY_V, FULL_V = 10.5, 12.3
STATIC_FRAMES = {  # (parent, translation [m])
    "base_link": ("base_footprint", (0.0, 0.0, 0.010)),
    "imu_link": ("base_link", (-0.032, 0.0, 0.068)),
    "base_scan": ("base_link", (-0.032, 0.0, 0.172)),
}


def stamp(ns: int) -> Any:
    """Return a ROS time."""
    return rclpy.time.Time(nanoseconds=ns).to_msg()


def heading(angle_rad: float) -> Quaternion:
    """Return the quaternion of a yaw angle."""
    return Quaternion(z=math.sin(angle_rad / 2), w=math.cos(angle_rad / 2))


class TurtleBot3(Node):
    """Publishes sensors and odometry, and obeys `cmd_vel`."""

    def __init__(self, settings: Mapping[str, Any], line: socket.socket) -> None:
        super().__init__("turtlebot3_node", namespace=settings["namespace"])
        self._line = line
        space = settings["namespace"].strip("/")
        self._prefix = f"{space}/" if space else ""
        self._pose = [0.0, 0.0, 0.0]
        self._before: tuple[int, list[float], float] | None = None
        default = QoSProfile(depth=10)
        self._scans = self.create_publisher(LaserScan, "scan", qos_profile_sensor_data)
        self._odometry = self.create_publisher(Odometry, "odom", default)
        self._imu = self.create_publisher(Imu, "imu", default)
        self._battery = self.create_publisher(BatteryState, "battery_state", default)
        self._joints = self.create_publisher(JointState, "joint_states", default)
        self._tf = self.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))
        fixed = profile(transient_local=True, depth=1)
        self._static = self.create_publisher(TFMessage, "/tf_static", fixed)
        self._static.publish(self._static_frames())
        if settings.get("stamped", False):
            self.create_subscription(
                TwistStamped, "cmd_vel", lambda message: self._obey(message.twist), default
            )
        else:
            self.create_subscription(Twist, "cmd_vel", self._obey, default)
        self.create_service(Trigger, "reset_odometry", self._reset)
        self.create_timer(SENSORS_S, lambda: self._send({"read": True}))
        self.create_timer(HEARTBEAT_S, lambda: self._send({"heartbeat": True}))
        self.create_timer(POLL_S, self._process_messages)

    def _static_frames(self) -> TFMessage:
        message = TFMessage()
        for child, (parent, place) in STATIC_FRAMES.items():
            stamped = TransformStamped(child_frame_id=self._prefix + child)
            stamped.header.frame_id = self._prefix + parent
            stamped.header.stamp = self.get_clock().now().to_msg()
            moved = stamped.transform.translation
            moved.x, moved.y, moved.z = place
            message.transforms.append(stamped)
        return message

    def _send(self, message: Mapping[str, Any]) -> None:
        try:
            self._line.send(json.dumps(message).encode())
        except BlockingIOError:
            return

    def _obey(self, twist: Twist) -> None:
        hundredths = [int(twist.linear.x * 100), int(twist.angular.z * 100)]
        self._send({"command": hundredths})

    def _reset(self, _: Any, response: Any) -> Any:
        self._pose = [0.0, 0.0, 0.0]
        response.success, response.message = True, "Odometry reset"
        return response

    def _process_messages(self) -> None:
        """Publish the newest registers and the newest scan from the robot."""
        newest: dict[str, Any] = {}
        while True:
            try:
                packet = self._line.recv(1 << 16)
            except BlockingIOError:
                break
            except ConnectionResetError:
                packet = b""
            if not packet:  # the robot has ended
                raise ExternalShutdownException
            newest |= json.loads(packet)
        if "registers" in newest:
            self._publish(newest["registers"])
        if "scan" in newest:
            self._scans.publish(self._scan(newest["scan"], newest["taken_ns"]))

    def _scan(self, scan: Mapping[str, Any], taken_ns: int) -> LaserScan:
        message = LaserScan(
            angle_min=0.0,
            angle_max=math.tau - scan["angle_increment"],
            angle_increment=scan["angle_increment"],
            time_increment=scan["scan_time"] / len(scan["ranges"]),
            scan_time=scan["scan_time"],
            range_min=scan["range_min"],
            range_max=scan["range_max"],
            ranges=scan["ranges"],
        )
        message.header.frame_id = self._prefix + "base_scan"
        message.header.stamp = stamp(taken_ns)
        return message

    def _publish(self, registers: Mapping[str, Any]) -> None:
        now_ns = time.time_ns()
        now = stamp(now_ns)
        imu = Imu(orientation=heading(registers["angle_rad"]))
        imu.header.stamp, imu.header.frame_id = now, self._prefix + "imu_link"
        imu.angular_velocity.z, imu.linear_acceleration.z = registers["turn_radps"], 9.81
        self._imu.publish(imu)
        joints = JointState(position=registers["wheels_rad"], velocity=registers["rims_mps"])
        joints.name = [f"{self._prefix}wheel_{side}_joint" for side in ("left", "right")]
        joints.header.stamp, joints.header.frame_id = now, self._prefix + "base_link"
        self._joints.publish(joints)
        volts = registers["volts"]
        battery = BatteryState(voltage=volts, design_capacity=1.8, present=volts > 7.0)
        battery.percentage = 100 * (volts - EMPTY_V) / (FULL_V - EMPTY_V)
        battery.header.stamp = now
        self._battery.publish(battery)
        self._update_odometry(now_ns, registers)

    def _update_odometry(self, now_ns: int, registers: Mapping[str, Any]) -> None:
        """Update odometry from wheels and gyroscope, and publish it with its transform."""
        wheels_rad, angle_rad = registers["wheels_rad"], registers["angle_rad"]
        before_ns, before_wheels, before_angle = self._before or (now_ns, wheels_rad, angle_rad)
        self._before = now_ns, wheels_rad, angle_rad
        if now_ns == before_ns:
            return
        turns = [now - then for now, then in zip(wheels_rad, before_wheels, strict=True)]
        step_m = WHEEL_RADIUS_M * sum(turns) / 2
        turned_rad = angle_rad - before_angle  # not wrapped to half a turn, as in the original
        self._pose[0] += step_m * math.cos(self._pose[2] + turned_rad / 2)
        self._pose[1] += step_m * math.sin(self._pose[2] + turned_rad / 2)
        self._pose[2] += turned_rad
        dt_s = (now_ns - before_ns) / 1e9
        message = Odometry(child_frame_id=self._prefix + "base_footprint")
        message.header.stamp, message.header.frame_id = stamp(now_ns), self._prefix + "odom"
        place = message.pose.pose.position
        place.x, place.y = self._pose[:2]
        message.pose.pose.orientation = heading(self._pose[2])
        message.twist.twist.linear.x, message.twist.twist.angular.z = (
            step_m / dt_s,
            turned_rad / dt_s,
        )
        self._odometry.publish(message)
        transform = TransformStamped(header=message.header, child_frame_id=message.child_frame_id)
        moved = transform.transform.translation
        moved.x, moved.y = self._pose[:2]
        transform.transform.rotation = message.pose.pose.orientation
        self._tf.publish(TFMessage(transforms=[transform]))


def main() -> None:
    """Run until the robot ends."""
    settings = json.loads(sys.argv[1])
    line = socket.socket(fileno=settings["line"])
    line.setblocking(False)
    os.set_inheritable(line.fileno(), False)
    rclpy.init()
    node = TurtleBot3(settings, line)
    with suppress(KeyboardInterrupt, ExternalShutdownException, BrokenPipeError):
        rclpy.spin(node)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
