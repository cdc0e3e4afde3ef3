"""Others on the robot's network: a second commander, a viewer that hangs, copies of everything."""

import asyncio
import itertools
import random
import signal
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import msgspec

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import CMD_VEL, IMAGE, INTENT, SAFETY, SCAN, STATE, WORLD
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.client.robot import connect
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.forger import forging
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.spoiled import HOLE, proxy_to
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.runtime.deployment import client_endpoint

COMMANDS, AT_ONCE = 10_000, 40
SPEED, MOVES = 0.1, 0.02  # [m/s]
PICTURE = Image(frame_id="camera", encoding="mono8", height=1000, width=1000, data=bytes(1_000_000))
PICTURES, PICTURE_S = 120, 1 / 30
COPIES, SPREAD_S = 2, 0.1
COPIED = (SCAN, STATE, WORLD, INTENT, CMD_VEL, SAFETY)
WATCH_TICKS = 250
HEALTH_TICKS = 75  # until the driver has told what it refused


async def two_commanders_across_a_partition(rig: Rig) -> Measured:
    """The first is cut off while it drives, the second takes over, the first comes back."""
    subject = await rig.robot("sim")
    onlooker, near = subject.onlooker, client_endpoint(subject.deployment)
    await subject.drive()  # all is well, and somebody may take over
    async with (
        proxy_to(subject) as (proxy, far),
        connect(far.connect[0], source="first", take=True) as first,
        connect(near.connect[0], source="second", take=True) as second,
    ):
        await first.set_base_velocity(SPEED)
        await until(lambda: onlooker.state.velocity.linear_x > SPEED / 2, "the first drives")
        proxy.set(HOLE)
        await until(lambda: onlooker.state.gate.mode == "idle", "the gate shuts")
        await second.set_base_velocity(0.0)
        await onlooker.still()
        start = onlooker.state
        proxy.set()
        async with forging(far) as forger:
            for number in range(COMMANDS):
                forger.send(CMD_VEL, _fresh(subject, number))
                if number % AT_ONCE == 0:
                    await second.set_base_velocity(0.0)
                    await asyncio.sleep(0.02)
        await onlooker.ticks(10)
        if onlooker.state.gate.commander != "second":
            raise Failed("the second has lost the body")
        moving = [s for s in onlooker.states if s.boot == start.boot and s.tick > start.tick]
    return {"executed of the first": sum(abs(s.velocity.linear_x) > MOVES for s in moving)}


def _fresh(subject: Subject, number: int) -> CmdVel:
    """A command of the first, with all that the gate asks for but the body."""
    time = subject.onlooker.bus.time
    return CmdVel(
        linear_x=SPEED,
        source="first",
        boot=time.boot,
        tick=time.tick,
        basis=time.tick,
        seq=1_000_000 + number,
    )


async def viewer_frozen(rig: Rig) -> Measured:
    """Somebody looks on and hangs, while a camera sends a megabyte thirty times a second.

    Judged against the same time without either, on the same machine.
    """
    subject = await rig.robot("sim")
    calm_ms, _ = await _filmed(subject, None)
    async with _frozen_viewer(client_endpoint(subject.deployment)):
        period_ms, puts_ms = await _filmed(subject, PICTURE)
    return {
        "control period p99 above calm": period_ms - calm_ms,
        "put p99": percentile(sorted(puts_ms), 0.99) or 0.0,
    }


async def _filmed(subject: Subject, picture: Image | None) -> tuple[float, list[float]]:
    """Control's period (p99) while it drives and pictures are sent, and how long each put took."""
    onlooker, puts_ms = subject.onlooker, list[float]()
    await subject.drive()
    start = onlooker.state
    for _ in range(PICTURES):
        began_s = time.perf_counter()
        if picture:
            onlooker.bus.publish(IMAGE, picture, name="front")
        puts_ms.append((time.perf_counter() - began_s) * 1e3)
        await asyncio.sleep(PICTURE_S)
    return onlooker.period_ms(start), puts_ms


VIEWER = """
import asyncio, signal, sys, msgspec
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
async def main():
    transport = await ZenohTransport.open(msgspec.json.decode(sys.argv[1], type=Endpoint))
    for key in ("robot/*", "robot/*/*"):
        transport.subscribe(key, lambda key, payload: None, 16)
    print("up", flush=True)
    await asyncio.sleep(3600)
asyncio.run(main())
"""


@asynccontextmanager
async def _frozen_viewer(where: Endpoint) -> AsyncIterator[None]:
    """A process that has subscribed to everything, and stands still."""
    viewer = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-c", VIEWER, msgspec.json.encode(where).decode()),
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert viewer.stdout
        await viewer.stdout.readline()
        await asyncio.sleep(0.2)  # it is heard of
        viewer.send_signal(signal.SIGSTOP)
        yield
    finally:
        viewer.kill()
        await viewer.wait()


async def duplicated_and_reordered(rig: Rig) -> Measured:
    """Everything that drives the robot arrives twice more, in another order."""
    subject = await rig.robot("sim")
    onlooker = subject.onlooker
    await subject.drive()
    before, start = await _refused(subject), onlooker.state
    async with _copies(client_endpoint(subject.deployment)) as sent:
        await onlooker.ticks(WATCH_TICKS)
    refused = await _refused(subject) - before
    states = [s for s in onlooker.states if s.boot == start.boot and s.tick >= start.tick]
    stops = sum(a.gate.mode == "enabled" != b.gate.mode for a, b in itertools.pairwise(states))
    if sent.count(CMD_VEL.key) < WATCH_TICKS:
        raise Failed(f"only {sent.count(CMD_VEL.key)} commands were copied")
    return {
        "effects beyond the first copy": stops + max(0, sent.count(CMD_VEL.key) - refused),
    }


async def _refused(subject: Subject) -> int:
    """How many commands the gate has refused, once the driver has told."""
    await subject.onlooker.ticks(HEALTH_TICKS)
    counters = subject.onlooker.health["driver"].counters
    return sum(count for name, count in counters.items() if name.startswith("refused_"))


@asynccontextmanager
async def _copies(where: Endpoint) -> AsyncIterator[list[str]]:
    """Copy what comes for the first time; the keys of all copies that were sent."""
    transport = await ZenohTransport.open(where)
    loop, chance = asyncio.get_running_loop(), random.Random(1)
    seen: set[tuple[str, bytes]] = set()
    sent: list[str] = []
    topics = {topic.key: topic for topic in COPIED}

    def again(key: str, payload: bytes) -> None:
        transport.publish(topics[key], key, payload, "")
        sent.append(key)

    def hear(key: str, payload: bytes) -> None:
        if (key, payload) in seen:
            return
        seen.add((key, payload))
        for _ in range(COPIES):
            timers.append(loop.call_later(SPREAD_S * chance.random(), again, key, payload))

    timers: list[asyncio.TimerHandle] = []
    closes = [transport.subscribe(key, hear, 64) for key in topics]
    try:
        yield sent
    finally:
        for close in closes:
            close()
        await asyncio.sleep(SPREAD_S)
        await transport.close()
