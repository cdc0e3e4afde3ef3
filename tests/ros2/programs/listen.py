"""Subscribes to topics, and reports messages, times and endpoints.

Commands: `subscribe`, `unsubscribe`, `report` (count, rate, times, newest values), `endpoints`.
"""

import time
from collections import deque
from typing import Any

from rclpy.clock import Clock

from tests.ros2.programs.console import endpoints, profile, start
from tests.ros2.programs.events import emit
from tests.ros2.programs.messages import find, to_json

MAX_TIMES = 1000  # arrival times that are kept for each topic


class Topic:
    """Keeps the newest messages of one topic, and their times."""

    def __init__(self, name: str, stream: bool, keep: int) -> None:
        self.count = 0
        self._name, self._stream = name, stream
        self._times_ns: deque[int] = deque(maxlen=MAX_TIMES)
        self._sent_ns: deque[int] = deque(maxlen=MAX_TIMES)
        self._last: deque[Any] = deque(maxlen=keep)

    def take(self, message: Any, info: dict[str, int]) -> None:
        """Add a message; `info` has the Unix time at which it was sent."""
        now_ns = time.monotonic_ns()
        self.count += 1
        self._times_ns.append(now_ns)
        self._sent_ns.append(info["source_timestamp"])
        self._last.append(message)
        if self._stream:
            value = to_json(message)
            emit("message", topic=self._name, at_ns=now_ns, value=value)

    def report(self) -> dict[str, Any]:
        """Return the statistics; `hz` is the mean rate between the first and the last kept time."""
        times = list(self._times_ns)
        span_ns = times[-1] - times[0] if len(times) > 1 else 0
        return {
            "count": self.count,
            "hz": (len(times) - 1) / (span_ns / 1e9) if span_ns else 0.0,
            "times_ns": times,
            "sent_ns": list(self._sent_ns),
            "values": [to_json(message) for message in self._last],
        }


def main() -> None:
    """Run until stdin ends."""
    console = start()
    topics: dict[str, Topic] = {}
    subscriptions: dict[str, Any] = {}

    def subscribe(
        topic: str, type: str, qos: dict[str, Any], stream: bool = False, keep: int = 1
    ) -> None:
        statistics = topics[topic] = Topic(topic, stream, keep)
        subscriptions[topic] = console.node.create_subscription(
            find(type), topic, statistics.take, profile(**qos)
        )

    def unsubscribe(topic: str) -> None:
        console.node.destroy_subscription(subscriptions.pop(topic))

    def report(topic: str) -> dict[str, Any]:
        clock_ns = Clock().now().nanoseconds
        return topics[topic].report() | {"now_ns": clock_ns}

    console.commands |= {
        "subscribe": subscribe,
        "unsubscribe": unsubscribe,
        "report": report,
        "endpoints": lambda topic: endpoints(console.node, topic),
    }
    console.run()


if __name__ == "__main__":
    main()
