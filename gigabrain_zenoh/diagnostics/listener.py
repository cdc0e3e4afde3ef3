"""Finds a topic by name, and receives its messages."""

import asyncio
import os
import stat
import threading
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Final

from msgspec import Struct

from gigabrain_schemas.requests import Description
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.discovery import (
    TopicPattern,
    check_topic,
    discover,
    topic_pattern,
    unknown_topic,
)
from gigabrain_zenoh.diagnostics.topic_stats import TopicMonitor, monitored
from gigabrain_zenoh.runtime.connect import Where, connect
from gigabrain_zenoh.runtime.running import find_endpoint

SNAPSHOT_S = 1.2  # long enough for topics of 1 Hz
MAX_QUEUED = 256  # messages waiting for display; then the oldest is dropped
CLIENT_NAME = "tool"
ALL_KEYS, ROBOT_KEYS = "**", "robot/**"
STDOUT: Final = 1  # file descriptor; sys.stdout may be replaced


class RawMessage(Struct, frozen=True):
    """One received message, not decoded."""

    key: str
    payload: bytes


class Snapshot(Struct, frozen=True):
    """Messages and processes on the bus during a short time."""

    start_ns: int
    monitor: TopicMonitor
    processes: dict[str, Description]

    @property
    def live_keys(self) -> set[str]:
        """Return the keys on which a message was sent."""
        published = {key for each in self.processes.values() for key in each.publishes}
        return published | set(self.monitor.streams())


def widest_pattern(where: Where) -> str:
    """Return the widest allowed key expression; with keys a router permits only the robot's."""
    keys = find_endpoint(where.connect, where.namespace, where.keys).keys
    return ROBOT_KEYS if keys else ALL_KEYS


async def snapshot(bus: Bus, pattern: str = ALL_KEYS, seconds: float = SNAPSHOT_S) -> Snapshot:
    """Count messages for `seconds`, and discover the processes meanwhile."""
    with monitored(bus, pattern) as monitor:
        start_ns = bus.clock.now_ns()
        processes, _ = await asyncio.gather(discover(bus), asyncio.sleep(seconds))
    return Snapshot(start_ns, monitor, processes)


@asynccontextmanager
async def open_topic(
    where: Where, name: str, *, looks_on: bool = False
) -> AsyncIterator[tuple[Bus, TopicPattern]]:
    """Connect, and find the topic `name`. Raises BusError and ConfigError."""
    found = topic_pattern(name)
    if found is None:
        check_topic(name)
    async with connect(where, CLIENT_NAME, looks_on=looks_on) as bus:
        if found is None:
            live_keys = (await snapshot(bus, widest_pattern(where))).live_keys
            found = topic_pattern(name, live_keys)
            if found is None:
                raise unknown_topic(name, live_keys)
        yield bus, found


async def messages(bus: Bus, wanted: TopicPattern) -> AsyncIterator[RawMessage | int]:
    """Yield messages as they arrive, the kept value first; an int counts dropped messages.

    Zenoh's thread queues them, as the output may block the event loop for any time.
    """
    loop, arrived = asyncio.get_running_loop(), asyncio.Event()
    queue: deque[RawMessage] = deque(maxlen=MAX_QUEUED)
    lock, dropped, waking = threading.Lock(), 0, False

    def receive(key: str, _encoding: str, payload: bytes) -> None:
        nonlocal dropped, waking
        with lock:
            dropped += len(queue) == MAX_QUEUED
            queue.append(RawMessage(key, payload))
            wakes, waking = not waking, True
        if wakes:
            loop.call_soon_threadsafe(arrived.set)

    close = bus.tap(wanted.pattern, receive)
    try:
        if wanted.topic and wanted.topic.keep:
            for payload in await bus.kept(wanted.topic):
                yield RawMessage(wanted.topic.key, payload)
        while True:
            await arrived.wait()
            arrived.clear()
            with lock:
                count, dropped, waking = dropped, 0, False
            if count:
                yield count
            while queue:
                yield queue.popleft()
    finally:
        close()


@contextmanager
def stop_on_broken_pipe(stop: asyncio.Event) -> Iterator[None]:
    """Set `stop` as soon as the other end of the pipe on stdout is closed.

    Otherwise `gigabrain log --follow | head -1` would end only at the next line.
    """
    loop = asyncio.get_running_loop()
    if not stat.S_ISFIFO(os.fstat(STDOUT).st_mode):
        yield
        return

    def closed() -> None:
        loop.remove_reader(STDOUT)
        stop.set()

    loop.add_reader(STDOUT, closed)  # the writing end is never readable, so this runs only on close
    try:
        yield
    finally:
        loop.remove_reader(STDOUT)
