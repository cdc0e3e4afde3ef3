"""One process of the bare relay, built with dora or ROS 1, for `bench chain --peers`.

An interpreter with dora or rospy runs `python peer_node.py ROLE`, so it imports nothing of ours.
ROLE is JSON: `system`, `index` (0 for the source) and `sizes` of the messages. For the source it
also has `rate_hz`, `settle_s`, `seconds` and `result`, the file for its times [ms].
"""

import json
import math
import os
import sys
import threading
import time
from typing import Any

STAMP_BYTES = 8
LOST_S = 0.3  # later messages count as lost


class Source:
    """Creates messages, and measures the time until they come back."""

    def __init__(self, role: dict[str, Any]) -> None:
        self._role, self._filler = role, bytes(role["sizes"][0] - STAMP_BYTES)
        self._times_ms: list[float] = []
        self._begin = math.inf  # time of the first message that came back [s]

    @property
    def over(self) -> bool:
        """True when no more messages are expected."""
        whole_s: float = self._role["settle_s"] + self._role["seconds"] + LOST_S
        return time.monotonic() - self._begin > whole_s

    def message(self) -> bytes:
        """Return the next message."""
        return time.monotonic_ns().to_bytes(STAMP_BYTES, "little") + self._filler

    def take(self, message: bytes) -> None:
        """Add the time of a message that came back."""
        now_ns = time.monotonic_ns()
        sent_ns = int.from_bytes(message[:STAMP_BYTES], "little")
        self._begin = min(self._begin, now_ns / 1e9)
        if sent_ns / 1e9 - self._begin > self._role["settle_s"]:
            self._times_ms.append((now_ns - sent_ns) / 1e6)

    def save(self) -> None:
        """Write the times to the file, atomically."""
        path = self._role["result"]
        with open(path + ".part", "w", encoding="utf-8") as file:
            json.dump(self._times_ms, file)
        os.replace(path + ".part", path)


def passed_on(message: bytes, size: int) -> bytes:
    """Return a message that is cut or padded to the next hop's size [bytes]."""
    return message[:size] + bytes(max(0, size - len(message)))


def run_dora(role: dict[str, Any]) -> None:
    """Relay as a node of a dora dataflow, from `in` to `out`; the source also has `tick`."""
    from dora import Node

    node, size = Node(), role["sizes"][role["index"]]
    source = None if role["index"] else Source(role)
    for event in node:
        if event["type"] == "STOP" or (source and source.over):
            break
        if event["type"] != "INPUT":
            continue
        if source and event["id"] == "tick":
            node.send_output("out", source.message())
            continue
        message = event["value"].to_numpy().tobytes()
        if source:
            source.take(message)
        else:
            node.send_output("out", passed_on(message, size))
    if source:
        source.save()


def run_ros1(role: dict[str, Any]) -> None:
    """Relay as a node of ROS 1, without Nagle's delay."""
    import rospy
    from std_msgs.msg import UInt8MultiArray

    index, size = role["index"], role["sizes"][role["index"]]
    source = None if index else Source(role)
    rospy.init_node(f"relay_{index}", disable_rosout=True)
    out = rospy.Publisher(f"relay/{index}", UInt8MultiArray, queue_size=1, tcp_nodelay=True)

    def take(message: Any) -> None:
        if source:
            source.take(message.data)
        else:
            out.publish(UInt8MultiArray(data=passed_on(message.data, size)))

    previous = (index - 1) % len(role["sizes"])
    rospy.Subscriber(f"relay/{previous}", UInt8MultiArray, take, tcp_nodelay=True)
    if source is None:
        rospy.spin()
        return
    timer = threading.Event()
    begin, sent = time.monotonic(), 0
    while not source.over:
        out.publish(UInt8MultiArray(data=source.message()))
        sent += 1
        timer.wait(max(0.0, begin + sent / role["rate_hz"] - time.monotonic()))
    source.save()


if __name__ == "__main__":
    own_role = json.loads(sys.argv[1])
    {"dora": run_dora, "rospy": run_ros1}[own_role["system"]](own_role)
