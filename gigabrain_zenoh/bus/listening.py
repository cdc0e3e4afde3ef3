"""Topics by name, as async iterators, and sampled for viewers."""

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import AsyncIterator
from typing import Any, TypeVar

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import TOPICS, Topic, current_key
from gigabrain_zenoh.bus.bus import Bus, Latest
from gigabrain_zenoh.bus.freshness import CLOCK_KEYS, CONFIRMATIONS
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.errors import BodyLost, unknown

M = TypeVar("M", bound=Message)
TOPIC_BY_KEY: dict[str, Topic[Any]] = {topic.key: topic for topic in TOPICS}
MAX_WAITING = 64  # messages for a slow `async for`; the oldest are dropped
SLICE_S = 0.1  # part of a timeout; a process that is stopped meanwhile loses only one


def topic_named(name: str) -> Topic[Any]:
    """Return a topic by its name, such as `robot/scan` or `scan`. Raises UnknownName."""
    known = {topic.key.removeprefix("robot/"): topic for topic in TOPICS}
    short = current_key(f"robot/{name.removeprefix('robot/')}").removeprefix("robot/")
    if short not in known:
        raise unknown("topic", name, known)
    return known[short]


def topic_of(key: str) -> Topic[Any] | None:
    """Return the topic of a key; None for a key that is not in the topic table."""
    if key in TOPIC_BY_KEY:
        return TOPIC_BY_KEY[key]
    topic = TOPIC_BY_KEY.get(key.rpartition("/")[0])
    return topic if topic and topic.many else None


async def arrival(arrived: asyncio.Event, timeout_s: float | None) -> None:
    """Wait until `arrived` is set; without a timeout for ever.

    Raises TimeoutError after `timeout_s`. Time in which this process is stopped does not count.
    """
    left_s = math.inf if timeout_s is None else timeout_s
    while left_s > 0.0:
        with contextlib.suppress(TimeoutError):
            # not `wait_for`, which may swallow a cancellation
            async with asyncio.timeout(min(left_s, SLICE_S)):
                await arrived.wait()
                return
        left_s -= SLICE_S
    raise TimeoutError


async def listen(bus: Bus, topic: Topic[M], timeout_s: float | None = None) -> AsyncIterator[M]:
    """Yield every message on `topic` from the first `anext` on.

    Raises BodyLost after `timeout_s` without a message; without a timeout it waits for ever.
    """
    waiting: deque[M] = deque(maxlen=MAX_WAITING)
    arrived = asyncio.Event()

    def receive(_key: str, message: M) -> None:
        waiting.append(message)
        arrived.set()

    close = bus.subscribe(topic, receive)
    try:
        while True:
            while waiting:
                yield waiting.popleft()
            arrived.clear()
            await arrival(arrived, timeout_s)
    except TimeoutError:
        text = f"no message on {topic.key} for {timeout_s:g} s; is it published?"
        raise BodyLost(text) from None
    finally:
        close()


SHOWN_NS = 500_000_000  # maximum age of a message that is shown


class Sampled(Latest[M]):
    """Newest message of a topic, decoded only when it is read."""

    def __init__(self, bus: Bus, topic: Topic[M]) -> None:
        super().__init__(topic, bus.clock, bus.time)
        self._robot_time = bus.time if topic.key in CLOCK_KEYS else None
        self._codec = Codec(topic.type, topic.max_bytes)
        # topics that move the clock keep enough messages to confirm a jump between two reads
        self._raw: deque[bytes] = deque(maxlen=CONFIRMATIONS if self._robot_time else 1)
        if not topic.many:
            bus.tap(topic.key, self.receive)

    def receive(self, _key: str, _encoding: str, payload: bytes) -> None:
        """Keep an encoded payload. May be called from any thread."""
        self._raw.append(payload)

    def poll(self) -> M | None:
        """Return the newest valid message since the last call; None if there is none."""
        while self._raw:
            try:
                message = self._codec.decode(self._raw.pop())
            except ValueError:
                continue
            if self._robot_time and not self._robot_time.observe(message):
                continue
            self._raw.clear()
            return message if self.store(message) else None
        return None

    def fresh(self, within_ns: int | None = SHOWN_NS) -> M | None:
        """Return the newest message if it is recent enough to show, else None."""
        self.poll()
        return super().fresh(within_ns)
