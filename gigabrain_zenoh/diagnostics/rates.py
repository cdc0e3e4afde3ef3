"""Overhears a running chain: when each hop sent, and what it sent."""

import statistics
from collections.abc import Mapping
from typing import Any, TypeVar

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import BODY, CMD_VEL, INTENT, SCAN, STATE, WORLD, Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus

M = TypeVar("M", bound=Message)

HOPS: tuple[Topic[Any], ...] = (SCAN, WORLD, INTENT, CMD_VEL)
ALL: tuple[Topic[Any], ...] = (*HOPS, STATE, BODY)


class Heard:
    """What the chain has sent: newest message per topic, and when each tick's first one left."""

    def __init__(self) -> None:
        self._newest: dict[str, Message] = {}
        self._left_ns: dict[str, dict[int, int]] = {topic.key: {} for topic in HOPS}

    def hear(self, key: str, message: Message) -> None:
        """Take one message. All processes of a chain stamp by one host's clock."""
        self._newest[key] = message
        if key in self._left_ns:
            self._left_ns[key].setdefault(message.basis, message.stamp_ns)

    @property
    def complete(self) -> bool:
        """Whether everything has been heard, and one scan followed all the way."""
        followed = set.intersection(*(set(left) for left in self._left_ns.values()))
        return bool(followed) and all(topic.key in self._newest for topic in ALL)

    def get(self, topic: Topic[M]) -> M:
        """The newest message on `topic`."""
        message = self._newest[topic.key]
        assert isinstance(message, topic.type)
        return message

    def sizes(self) -> list[int]:
        """Bytes of what each hop sends."""
        return [len(codec.encode(self.get(topic))) for topic in HOPS]

    def between(self, before: Topic[Any], after: Topic[Any]) -> float:
        """Median time from one hop's departure to the other's [ms], once all is complete."""
        return median_ms(self._left_ns[before.key], self._left_ns[after.key])


def median_ms(before: Mapping[int, int], after: Mapping[int, int]) -> float:
    """Median difference of two times per tick [ns], over the ticks that have both [ms]."""
    both = before.keys() & after.keys()
    return statistics.median((after[tick] - before[tick]) / 1e6 for tick in both)


def listen(bus: Bus) -> Heard:
    """Begin to listen."""
    heard = Heard()
    for topic in ALL:
        bus.subscribe(topic, heard.hear)
    return heard
