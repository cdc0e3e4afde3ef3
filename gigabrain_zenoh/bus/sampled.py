"""Keeps only the newest message of a busy topic, for viewers."""

from collections import deque
from typing import Generic, TypeVar

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.bus.bus import Bus, Latest
from gigabrain_zenoh.bus.freshness import CLOCK_KEYS, CONFIRMED
from gigabrain_zenoh.codec import Codec

M = TypeVar("M", bound=Message)

SHOWN_NS = 500_000_000  # maximum age of a message that is shown


class Sampled(Generic[M]):
    """Newest message of a topic, decoded only when it is read."""

    def __init__(self, bus: Bus, topic: Topic[M]) -> None:
        self._latest = Latest(topic, bus.clock, bus.time)
        self._time = bus.time if topic.key in CLOCK_KEYS else None
        self._codec = Codec(topic.type, topic.max_bytes)
        # topics that move the clock keep enough messages to confirm a jump between two reads
        self._raw: deque[bytes] = deque(maxlen=CONFIRMED if self._time else 1)
        if not topic.many:
            bus.tap(topic.key, self.take)

    def take(self, _key: str, _encoding: str, payload: bytes) -> None:
        """Keep an encoded payload. May be called from any thread."""
        self._raw.append(payload)

    def look(self) -> M | None:
        """Return the newest valid message since the last call; None if there is none."""
        while self._raw:
            try:
                message = self._codec.decode(self._raw.pop())
            except ValueError:
                continue
            if self._time and not self._time.see(message):
                continue
            self._raw.clear()
            return message if self._latest.take(message) else None
        return None

    def fresh(self) -> M | None:
        """Return the newest message if it is recent enough to show (SHOWN_NS), else None."""
        self.look()
        return self._latest.fresh(SHOWN_NS)
