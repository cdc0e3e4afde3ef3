"""Common parts of the rclpy programs: read commands on stdin, print events on stdout, as JSON.

A command is a line `{"do": name, "id": number, ...}`; the answer is an event with the same name and
id. A program ends when its stdin ends, or with the exception of a command that fails.
Times are from the monotonic clock, which all processes of a machine share.
"""

import json
import os
import queue
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from tests.ros2.programs.events import emit

Command = Callable[..., Mapping[str, Any] | None]


class Console:
    """A node and its commands, which run in one thread of an executor."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        rclpy.init()
        self.node = Node(settings["node"], namespace=settings.get("namespace", "/"))
        self.commands: dict[str, Command] = {}
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._line_arrived = self.node.create_guard_condition(self._obey)
        self._ended = False

    def run(self) -> None:
        """Obey commands until stdin ends."""
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        threading.Thread(target=self._read, daemon=True).start()
        emit("ready", pid=os.getpid())
        try:
            while not self._ended:
                executor.spin_once()
        except (KeyboardInterrupt, ExternalShutdownException):
            pass
        executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def _read(self) -> None:
        for line in sys.stdin:
            self._lines.put(line)
            self._line_arrived.trigger()
        self._ended = True
        self._line_arrived.trigger()

    def _obey(self) -> None:
        while not self._lines.empty():
            command = json.loads(self._lines.get())
            do, number = command.pop("do"), command.pop("id")
            answer = self.commands[do](**command) or {}
            emit(do, id=number, **answer)


def start() -> Console:
    """Return a console with the settings that the command line gives as JSON."""
    return Console(json.loads(sys.argv[1]))


def profile(reliable: bool = True, transient_local: bool = False, depth: int = 10) -> QoSProfile:
    """Return a quality of service."""
    durability = DurabilityPolicy.TRANSIENT_LOCAL if transient_local else DurabilityPolicy.VOLATILE
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=depth, reliability=reliability, durability=durability)


def endpoints(node: Node, topic: str) -> dict[str, list[dict[str, Any]]]:
    """Return the publishers and subscribers of a topic that ROS knows."""

    def described(info: Any) -> dict[str, Any]:
        return {
            "node": info.node_name,
            "namespace": info.node_namespace,
            "type": info.topic_type,
            "hash": str(info.topic_type_hash),
            "gid": bytes(info.endpoint_gid).hex(),
            "reliable": info.qos_profile.reliability == ReliabilityPolicy.RELIABLE,
            "transient_local": info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
            "depth": info.qos_profile.depth,
        }

    return {
        "publishers": [described(info) for info in node.get_publishers_info_by_topic(topic)],
        "subscribers": [described(info) for info in node.get_subscriptions_info_by_topic(topic)],
    }
