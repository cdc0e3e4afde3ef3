"""Faults that somebody wants: old traffic played again, and connections without an end."""

import asyncio
import contextlib
import os
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from gigabrain_schemas.topics import (
    CMD_VEL,
    ESTOP,
    INTENT,
    SAFETY,
    SCAN,
    STATE,
    TELEOP,
    WORLD,
)
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.client.robot import connect
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host.posix import resource
from gigabrain_zenoh.qa.faults.fault import Measured, Skipped
from gigabrain_zenoh.qa.faults.intruders import unauthorised_publisher
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.spoiled import address_of
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.runtime.deployment import client_endpoint

__all__ = ["idle_and_random_connections", "replayed_traffic", "unauthorised_publisher"]

SPEED, MOVES = 0.15, 0.01  # [m/s]
RECORDED = (SCAN, STATE, WORLD, INTENT, CMD_VEL, SAFETY, TELEOP)
RECORD_S, LONG_RECORD_S = 2.0, 60.0
AT_ONCE = 20  # messages between two breaths
IDLE_SOCKETS, SPARE_FILES = 1100, 200
CALLS, LONG_CALLS = 2_000, 100_000
PAUSE_S = 0.002  # between two of them: what is judged is the router, not how fast this can be
LONGEST_NOISE = 2_000  # bytes
BOMBS = (  # to a port that speaks Zenoh: a length of 64 kB and nothing, and what is no Zenoh at all
    b"\xff\xff" + bytes(64), b"\xff" * 65_537, b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n",
    bytes.fromhex("16030100ff010000fb0303") + bytes(244),
)  # fmt: skip
WATCH_S = 5.0


async def replayed_traffic(rig: Rig) -> Measured:
    """All that was said while somebody drove is said again: at once, and after a restart."""
    subject = await rig.robot("sim")
    where = client_endpoint(subject.deployment)
    tape = await _recorded(subject, where, LONG_RECORD_S if rig.long else RECORD_S)
    accepted = await _replayed(subject, where, tape)
    boot, pid = subject.onlooker.state.boot, subject.kill("driver")
    await subject.restarted("driver", pid)
    await until(lambda: subject.onlooker.state.boot != boot, "the driver's new start is heard")
    accepted += await _replayed(subject, where, tape)
    refused = await _refused_stops(subject, where)
    await subject.settle()
    return {"accepted": accepted, "e-stops refused after it": refused}


async def _recorded(subject: Subject, where: Endpoint, seconds: float) -> list[tuple[str, bytes]]:
    """What is heard while somebody turns the robot on the spot, forwards and on."""
    await subject.drive()
    tape: list[tuple[str, bytes]] = []
    ear = await ZenohTransport.open(where)
    for topic in RECORDED:
        ear.subscribe(topic.key, lambda key, payload: tape.append((key, payload)), 256)
    async with connect(where.connect[0], source="driver-of-old", take=True) as robot:
        await robot.drive(0.02, SPEED * 4, seconds=seconds)
    await ear.close()
    return tape


async def _replayed(subject: Subject, where: Endpoint, tape: list[tuple[str, bytes]]) -> int:
    """In how many ticks the body moved, while the same driver holds it still."""
    await subject.drive()  # all is well, and somebody may take over
    onlooker, topics = subject.onlooker, {topic.key: topic for topic in RECORDED}
    mouth = await ZenohTransport.open(where)
    try:
        async with connect(where.connect[0], source="driver-of-old", take=True) as robot:
            await robot.set_base_velocity(0.0)
            await onlooker.still()
            start = onlooker.state
            for number, (key, payload) in enumerate(tape):
                mouth.publish(topics[key], key, payload, "")
                if number % AT_ONCE == 0:
                    with contextlib.suppress(GigabrainError):  # old states are no good for anybody
                        await robot.set_base_velocity(0.0)
                    await asyncio.sleep(0.01)
            await onlooker.ticks(10)
    finally:
        await mouth.close()
    states = [s for s in onlooker.states if s.boot == start.boot and s.tick > start.tick]
    return sum(max(abs(s.velocity.linear_x), abs(s.velocity.angular_z)) > MOVES for s in states)


async def _refused_stops(subject: Subject, where: Endpoint) -> int:
    """An e-stop, the very same request again, and a new one: those that did not latch."""
    onlooker, stranger = subject.onlooker, await ZenohTransport.open(where)
    refused = 0
    try:
        for payload in (b'{"source": "old"}', b'{"source": "old"}', b"{}"):
            generation = onlooker.state.gate.estop_generation
            replies = await stranger.query(ESTOP.key, payload, "", 1.0, ESTOP.priority)
            await onlooker.ticks(3)
            gate = onlooker.state.gate
            latched = gate.mode == "latched" and gate.estop_generation > generation
            refused += not (latched and any(isinstance(reply, bytes) for reply in replies))
    finally:
        await stranger.close()
    return refused


async def idle_and_random_connections(rig: Rig) -> Measured:
    """Sockets that say nothing, noise, and things that are no Zenoh, at the router's own port."""
    subject = await rig.robot("sim")
    where = client_endpoint(subject.deployment)
    host, port = address_of(where)
    pid, loop = subject.pid("router"), asyncio.get_running_loop()
    await subject.drive()
    start = subject.onlooker.state
    await asyncio.sleep(WATCH_S)
    calm_ms = subject.onlooker.period_ms(start)
    async with _idle(host, port):
        began_s = loop.time()
        async with connect(where.connect[0], source="operator"):
            took_s = loop.time() - began_s
    calls = LONG_CALLS if rig.long else CALLS
    start = subject.onlooker.state
    await _noise(host, port, calls)
    period_ms = subject.onlooker.period_ms(start)
    return {
        "control period p99 above calm": period_ms - calm_ms,
        "operator connects after": took_s,
        "router deaths": int(subject.supervisor.statuses["router"].pid != pid),
    }


async def _noise(host: str, port: int, calls: int) -> None:
    """One call after the other; most say something at random."""
    for number in range(calls):
        noise = os.urandom(1 + number % LONGEST_NOISE)
        await _call(host, port, BOMBS[number % 100] if number % 100 < len(BOMBS) else noise)
        await asyncio.sleep(PAUSE_S)


@asynccontextmanager
async def _idle(host: str, port: int) -> AsyncIterator[None]:
    """So many connections that say nothing."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = IDLE_SOCKETS + SPARE_FILES
    if hard < wanted:
        raise Skipped(f"a process may open {hard} files here; {wanted} are needed")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, wanted), hard))
    loop, sockets = asyncio.get_running_loop(), list[socket.socket]()
    try:
        for _ in range(IDLE_SOCKETS):
            sockets.append(socket.socket())
            sockets[-1].setblocking(False)
            with contextlib.suppress(OSError, TimeoutError):
                async with asyncio.timeout(0.2):
                    await loop.sock_connect(sockets[-1], (host, port))
        yield
    finally:
        for one in sockets:
            one.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


async def _call(host: str, port: int, payload: bytes) -> None:
    """Connect, say this, and leave; a router that refuses does well."""
    loop = asyncio.get_running_loop()
    with socket.socket() as one:
        one.setblocking(False)
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(1.0):
                await loop.sock_connect(one, (host, port))
                await loop.sock_sendall(one, payload)
