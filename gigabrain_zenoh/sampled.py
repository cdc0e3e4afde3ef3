"""The newest message of a busy topic, for those who only show it."""

from collections import deque
from typing import Generic, TypeVar

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.bus import Bus, Latest
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.freshness import CLOCK_KEYS, CONFIRMED

M = TypeVar("M", bound=Message)

SHOWN_NS = 500_000_000  # how old a message may be that is shown to people


class Sampled(Generic[M]):
    """The newest message of a topic, which is decoded no more often than somebody looks."""

    def __init__(self, bus: Bus, topic: Topic[M]) -> None:
        self._latest = Latest(topic, bus.clock, bus.time)
        self._time = bus.time if topic.key in CLOCK_KEYS else None
        self._codec = Codec(topic.type, topic.max_bytes)
        # of those that move the clock so many that they can confirm a jump between two looks
        self._raw: deque[bytes] = deque(maxlen=CONFIRMED if self._time else 1)
        if not topic.many:
            bus.tap(topic.key, self.take)

    def take(self, _key: str, _encoding: str, payload: bytes) -> None:
        """Keep a payload, in whatever thread it comes."""
        self._raw.append(payload)

    def look(self) -> M | None:
        """The message that has come since the last look, if there is a valid one."""
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
        """The newest message, while it is worth showing."""
        self.look()
        return self._latest.fresh(SHOWN_NS)
