"""Stop a gigabrain robot when something comes near: a node in rclpy.

python stop.py [METRES] [--ros-args -r __ns:=/robot1]. It reads `scan`, and calls `estop` once a
beam is shorter. The robot then stays stopped until you call `release` and `enable`.
"""

import contextlib
import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import LaserScan
from std_srvs.srv import SetBool


class Stop(Node):
    """Presses the e-stop once, when a beam is shorter than `near` [m]."""

    def __init__(self, near: float) -> None:
        super().__init__("stop")
        self.near, self.scans = near, 0
        self.answer: rclpy.Future | None = None
        self.estop = self.create_client(SetBool, "estop")
        self.create_subscription(LaserScan, "scan", self.look, qos_profile_sensor_data)

    def look(self, scan: LaserScan) -> None:
        """Look at a scan. Infinite is free and nan is unknown: neither of them is near."""
        hits = [one for one in scan.ranges if scan.range_min <= one <= scan.range_max]
        nearest = min(hits, default=float("inf"))
        if self.scans % 10 == 0:
            print(f"{len(scan.ranges)} beams, the nearest {nearest:.2f} m", flush=True)
        self.scans += 1
        if nearest < self.near and self.answer is None and self.estop.service_is_ready():
            self.answer = self.estop.call_async(SetBool.Request(data=True))


rclpy.init()
words = remove_ros_args(sys.argv)
node = Stop(float(words[1]) if len(words) > 1 else 0.3)
with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
    while node.answer is None or not node.answer.done():
        rclpy.spin_once(node)
    print(f"e-stop: {node.answer.result().message}")
stopped = node.answer is not None and node.answer.done() and node.answer.result().success
node.destroy_node()
rclpy.try_shutdown()
sys.exit(0 if stopped else 1)
