"""Requests on ROS topics, which have no reply: diagnostics show refusals."""

import logging
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.gateway.background import Background
from gigabrain_zenoh.gateway.conversions.diagnostics import Level, Status
from gigabrain_zenoh.logs import QuietFault
from gigabrain_zenoh.ros2.qos import DEFAULT
from gigabrain_zenoh.ros2.transport import Close, Received, RosTransport
from gigabrain_zenoh.ros2.types import MAX_COMMAND, Types

log = logging.getLogger(__name__)
Ask = Callable[[Any], Awaitable[str]]  # raises GigabrainError; returns a text for the log


class TopicRequests:
    """Handles one message of a topic at a time; the newest one waits."""

    def __init__(self, bus: Bus, ros: RosTransport, types: Types, work: Background) -> None:
        self._bus, self._ros, self._types, self._work = bus, ros, types, work
        self.problems: dict[str, str] = {}  # last fault, by topic; an accepted message clears it

    def status(self) -> list[Status]:
        """Return lines of diagnostics with the last faults."""
        return [Status(topic, Level.WARN, text) for topic, text in self.problems.items()]

    def fail(self, topic: str, text: str) -> None:
        """Report a fault of a topic until its next message is accepted."""
        self.problems[topic] = text

    def serve(self, topic: str, name: str, ask: Ask, max_bytes: int = MAX_COMMAND) -> Close:
        """Subscribe to a topic of the type `name`."""
        waiting: deque[bytes] = deque(maxlen=1)
        busy, fault, clock = False, QuietFault(log), self._bus.clock

        async def work() -> None:
            nonlocal busy
            while waiting:
                try:
                    payload = waiting.pop()
                    text = await ask(self._types.decode_command(name, payload, max_bytes))
                except GigabrainError as error:
                    self.problems[topic] = f"refused: {error}"
                    self._bus.counters[f"{topic}_refused"] += 1
                    fault.begin(f"refused /{topic}: {error}", clock.now_ns())
                else:
                    self.problems.pop(topic, None)
                    fault.end(f"/{topic} is accepted again", clock.now_ns())
                    if text:
                        log.info("/%s: %s", topic, text)
            busy = False

        def handle(received: Received) -> None:
            nonlocal busy
            waiting.append(received.payload)
            if not busy:
                busy = True
                self._work.start(work())

        return self._ros.subscribe(topic, name, DEFAULT, handle)
