"""Topics as async iterators, found by the name that people use."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from typing import Any, TypeVar

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import TOPICS, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import unknown

M = TypeVar("M", bound=Message)

ROOM = 64  # messages that wait for a slow `async for`; the oldest give way


def topic_named(name: str) -> Topic[Any]:
    """The topic `robot/scan`, or `scan` for short. Raises UnknownName."""
    known = {topic.key.removeprefix("robot/"): topic for topic in TOPICS}
    short = name.removeprefix("robot/")
    if short not in known:
        raise unknown("topic", name, known)
    return known[short]


async def listen(bus: Bus, topic: Topic[M]) -> AsyncIterator[M]:
    """Every message on `topic` from the first `anext` on."""
    waiting: deque[M] = deque(maxlen=ROOM)
    arrived = asyncio.Event()

    def take(_key: str, message: M) -> None:
        waiting.append(message)
        arrived.set()

    close = bus.subscribe(topic, take)
    try:
        while True:
            while waiting:
                yield waiting.popleft()
            arrived.clear()
            await arrived.wait()
    finally:
        close()
