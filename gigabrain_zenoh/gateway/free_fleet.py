"""ROS topics and services for Open-RMF's adapter free_fleet, on plain Zenoh keys.

Keys and payloads are those of zenoh-bridge-ros2dds for a robot with Nav2, as in the source of
open-rmf/free_fleet at 002505f: below the robot's name, CDR, no type and no attachment. The name is
the robot's namespace on the bus, so the bus's own session can use these keys.
"""

import logging
from collections import Counter

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.logs import QuietFault
from gigabrain_zenoh.ros2.qos import DEFAULT, Qos
from gigabrain_zenoh.ros2.transport import Answer, Close, OnReaders

log = logging.getLogger(__name__)
TOPICS = ("tf", "battery_state")  # read by the adapter, besides the action navigate_to_pose


class FreeFleetPublisher:
    """A publisher on one key."""

    def __init__(self, bus: Bus, key: str, on_readers: OnReaders | None) -> None:
        self.readers = 0  # 1 if there are any
        self._transport, self._on_readers = bus.transport, on_readers
        self._topic = Topic(key, Message, 10)  # for its QoS
        self._close = bus.transport.watch_readers(key, self._count)

    def publish(self, payload: bytes) -> None:
        """Send to all readers, without waiting for any."""
        self._transport.publish(self._topic, self._topic.key, payload, "")

    def close(self) -> None:
        """Stop counting readers."""
        self._close()

    def _count(self, present: bool) -> None:
        self.readers = int(present)
        if self._on_readers:
            self._on_readers(self.readers)


class FreeFleet:
    """Offers topics and services of ROS on plain keys. A bad request is refused with its reason."""

    def __init__(self, bus: Bus) -> None:
        self.counts: Counter[str] = Counter()
        self._bus = bus

    def publisher(
        self, topic: str, type: str, qos: Qos = DEFAULT, on_readers: OnReaders | None = None
    ) -> FreeFleetPublisher:
        """Return a publisher; type and QoS are not sent."""
        return FreeFleetPublisher(self._bus, topic, on_readers)

    def serve(self, service: str, type: str, handle: Answer) -> Close:
        """Answer requests of a service, each in its own task."""
        fault, clock = QuietFault(log), self._bus.clock

        async def answer(request: bytes) -> tuple[bytes, str]:
            try:
                response = await handle(request)
            except GigabrainError as error:
                self.counts["refused"] += 1
                fault.begin(f"free_fleet: refused a request of {service}: {error}", clock.now_ns())
                raise
            fault.end(f"free_fleet: requests of {service} can be answered again", clock.now_ns())
            return response, ""

        return self._bus.transport.serve(service, answer)
