"""Programs that load a robot's machine or flood its network. For tests and benchmarks only.

Started as `python -m gigabrain_zenoh.qa.faults.cpu_load KIND ...`.
"""

import asyncio
import contextlib
import itertools
import json
import os
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace

import msgspec

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import CMD_VEL, DESCRIBE, IMAGE, INTENT, SCAN, STATE, TELEOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.host import this_process

PROGRAM = (sys.executable, "-P", "-m", "gigabrain_zenoh.qa.faults.cpu_load")
MEMORY_MB = 256
OBJECTS = 1_000_000
JSON_NUMBERS = 6_000_000  # about 50 MB of text

FLOODER = "flooder"
URGENT = replace(CMD_VEL, priority="real_time", express=True)
PERIOD_NS = 5_000_000
LARGE_PERIODS = 100  # periods between two large messages
LARGE_TOPICS = (IMAGE, SCAN, INTENT, TELEOP, CMD_VEL)  # of large messages, in turn
ASKED_KEY = DESCRIBE.at("driver")
ASKED_AT_ONCE, MAX_ASKED = 5, 2000  # queries per period, and pending queries
ANSWER_S = 5.0
PICTURES_HZ, PICTURE_BYTES = 100.0, 1_000_000
COMMANDS_PER_PICTURE = 10  # 1000 a second, of a client that has not asked for the body


def spin() -> None:
    """Use a core completely."""
    for _ in itertools.count():
        pass


def fill() -> None:
    """Write to 256 MB of memory, over and over."""
    held = bytearray(MEMORY_MB * 1_000_000)
    for turn in itertools.count():
        held[::4096] = bytes([turn % 256]) * len(held[::4096])


def litter() -> None:
    """Create objects for the garbage collector, a million at a time."""
    for _ in itertools.count():
        ring: list[object] = []
        ring.extend([ring] for _ in range(OBJECTS))


def parse() -> None:
    """Parse 50 MB of JSON, as a careless page might."""
    text = json.dumps(list(range(JSON_NUMBERS)))
    for _ in itertools.count():
        json.loads(text)


def flood(rate_hz: str, large_bytes: str, endpoint: str) -> None:
    """Send commands at `rate_hz`, queries at 1 kHz, and two large messages a second.

    The commands claim the highest priority. The process is niced: it stands for a client on another
    machine, whose work must not cost the robot's.
    """
    os.nice(19)
    asyncio.run(_flood(int(rate_hz), bytes(int(large_bytes)), endpoint))


async def _flood(rate_hz: int, large: bytes, endpoint: str) -> None:
    transport = await ZenohTransport.open(_decoded(endpoint))
    bus = Bus(transport, Clock(), FLOODER)
    bus.latest(STATE)
    print("up", flush=True)
    periods, asked = 0, set[asyncio.Task[list[bytes | str]]]()
    async for _ in bus.clock.every(PERIOD_NS):
        for _ in range(rate_hz * PERIOD_NS // 1_000_000_000):
            bus.publish(URGENT, CmdVel(linear_x=0.2, source=FLOODER))
        for _ in range(min(ASKED_AT_ONCE, MAX_ASKED - len(asked))):
            query = transport.query(ASKED_KEY, b"", "", ANSWER_S, DESCRIBE.priority)
            asked.add(task := asyncio.create_task(query))
            task.add_done_callback(asked.discard)
        periods += 1
        if periods % LARGE_PERIODS == 0:
            topic = LARGE_TOPICS[periods // LARGE_PERIODS % len(LARGE_TOPICS)]
            transport.publish(topic, topic.at(FLOODER), large, "")
        if periods % 200 == 0:
            print(bus.sent[CMD_VEL.key], flush=True)


def pictures(endpoint: str) -> None:
    """Send 100 pictures of 1 MB and 1000 commands a second, as the e-stop benchmark defines it."""
    asyncio.run(_pictures(_decoded(endpoint)))


async def _pictures(endpoint: Endpoint) -> None:
    picture = Image(frame_id="flood", encoding="jpeg", height=1, width=1, data=bytes(PICTURE_BYTES))
    command = CmdVel(linear_x=0.2, source="flood")
    bus, listener = [Bus(await ZenohTransport.open(endpoint), Clock(), "bench") for _ in range(2)]
    listener.subscribe(IMAGE, lambda _key, _picture: None)  # without a subscriber none is sent
    print('{"event": "ready"}', flush=True)
    async for _ in bus.clock.every(round(1e9 / PICTURES_HZ)):
        bus.publish(IMAGE, picture, name="flood")
        for _ in range(COMMANDS_PER_PICTURE):
            bus.publish(CMD_VEL, command)


def view(endpoint: str) -> None:
    """Subscribe to everything, as a viewer does."""
    asyncio.run(_view(_decoded(endpoint)))


async def _view(endpoint: Endpoint) -> None:
    transport = await ZenohTransport.open(endpoint)
    for key in ("robot/*", "robot/*/*"):
        transport.subscribe(key, lambda _key, _payload: None, 16)
    print("up", flush=True)
    await asyncio.Event().wait()


def endpoint_text(endpoint: Endpoint) -> str:
    """Return an endpoint in the form that these programs take."""
    return msgspec.json.encode(endpoint).decode()


def _decoded(endpoint: str) -> Endpoint:
    return msgspec.json.decode(endpoint, type=Endpoint)


KINDS: dict[str, Callable[..., None]] = {
    one.__name__: one for one in (spin, fill, litter, parse, flood, pictures, view)
}


@asynccontextmanager
async def running(kind: str, *words: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run one of these programs while the block lasts."""
    process = await asyncio.create_subprocess_exec(
        *(*PROGRAM, kind, *words),
        stdout=asyncio.subprocess.PIPE,
        env=os.environ | {this_process.SUPERVISOR_VARIABLE: str(os.getpid())},
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):  # it has already ended
            process.kill()
        await process.wait()


if __name__ == "__main__":
    this_process.die_with_supervisor()
    KINDS[sys.argv[1]](*sys.argv[2:])
