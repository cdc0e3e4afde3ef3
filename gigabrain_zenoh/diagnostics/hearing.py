"""Finds out what a name stands for, and listens to it."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from msgspec import Struct

from gigabrain_schemas.requests import Description
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.names import Target, not_found, target
from gigabrain_zenoh.diagnostics.roll_call import roll_call
from gigabrain_zenoh.diagnostics.tally import Tally, tallied
from gigabrain_zenoh.runtime.connect import Where, joined
from gigabrain_zenoh.runtime.running import find_endpoint

LOOK_S = 1.2  # so that what is sent once a second is heard
ROOM = 256  # messages that wait to be shown; the oldest give way
NAME = "tool"
OPEN, OURS = "**", "robot/**"  # with keys, a router lets nobody listen to more than the robot


class Heard(Struct, frozen=True):
    """One message as it came."""

    key: str
    encoding: str
    payload: bytes


class Look(Struct, frozen=True):
    """What a short look at the bus has found."""

    began_ns: int
    tally: Tally
    there: dict[str, Description]

    @property
    def alive(self) -> set[str]:
        """The keys that somebody has sent on."""
        said = {key for one in self.there.values() for key in one.publishes}
        return said | set(self.tally.streams())


def everything(where: Where) -> str:
    """The widest expression that may be listened to."""
    return OURS if find_endpoint(where.connect, where.namespace, where.keys).keys else OPEN


async def look(bus: Bus, pattern: str = OPEN, seconds: float = LOOK_S) -> Look:
    """Listen for a while, and ask who is there."""
    with tallied(bus, pattern) as tally:
        began_ns = bus.clock.now_ns()
        there, _ = await asyncio.gather(roll_call(bus), asyncio.sleep(seconds))
    return Look(began_ns, tally, there)


@asynccontextmanager
async def aimed(
    where: Where, name: str, *, looks_on: bool = False
) -> AsyncIterator[tuple[Bus, Target]]:
    """A bus, and the topic that people call `name`. Raises BusError, and UnknownName."""
    async with joined(where, NAME, looks_on=looks_on) as (bus, _):
        found = target(name)
        if found is None:
            alive = (await look(bus, everything(where))).alive
            found = target(name, alive)
            if found is None:
                raise not_found(name, alive)
        yield bus, found


async def messages(bus: Bus, aim: Target) -> AsyncIterator[Heard | int]:
    """All that comes, from the kept value on; a number for messages that had to give way."""
    loop, arrived = asyncio.get_running_loop(), asyncio.Event()
    waiting: deque[Heard] = deque(maxlen=ROOM)
    lost = 0

    def take(one: Heard) -> None:
        nonlocal lost
        lost += len(waiting) == ROOM
        waiting.append(one)
        arrived.set()

    def hear(key: str, encoding: str, payload: bytes) -> None:
        loop.call_soon_threadsafe(take, Heard(key, encoding, payload))

    close = bus.tap(aim.pattern, hear)
    try:
        if aim.topic and aim.topic.keep:
            for payload in await bus.kept(aim.topic):
                yield Heard(aim.topic.key, "", payload)
        while True:
            await arrived.wait()
            arrived.clear()
            if lost:
                told, lost = lost, 0
                yield told
            while waiting:
                yield waiting.popleft()
    finally:
        close()
