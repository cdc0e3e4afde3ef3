"""Other clients on the robot's network: a second commander, a frozen viewer, copied messages."""

import asyncio
import random
import signal
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import msgspec

from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import CMD_VEL, IMAGE, INTENT, SAFETY, SCAN, STATE, WORLD
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.client.robot import connect
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.qa.faults.fault import FaultRow
from gigabrain_zenoh.qa.faults.rig.bad_network import HOLE, forged_command, forging, proxy_to
from gigabrain_zenoh.qa.faults.rig.rig import Rig
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured
from gigabrain_zenoh.qa.probe import until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.runtime.deployment import client_endpoint

COMMANDS, AT_ONCE = 10_000, 40
SPEED, MOVES = 0.1, 0.02  # [m/s]
PICTURE = Image(frame_id="camera", encoding="mono8", height=1000, width=1000, data=bytes(1_000_000))
PICTURES, PICTURE_S = 120, 1 / 30
COPIES, SPREAD_S = 2, 0.1
COPIED = (SCAN, STATE, WORLD, INTENT, CMD_VEL, SAFETY)
WATCH_TICKS = 250
HEALTH_TICKS = 75  # until the driver has published its counters

FIRST_EXECUTED = Figure("commands of the first executed")
PERIOD_ADDED = Figure("control period p99 above calm", "ms")
PUT_P99 = Figure("put p99", "ms", wall=True)
COPY_EFFECTS = Figure("effects beyond the first copy")


async def two_commanders_across_a_partition(rig: Rig) -> Measured:
    """Cut the first commander off while it drives, let the second take over, heal the network."""
    robot = await rig.robot("sim")
    probe, near = robot.probe, client_endpoint(robot.deployment)
    await robot.drive()  # all is well, and a client may take over
    async with (
        proxy_to(robot) as (proxy, far),
        connect(far.connect[0], source="first", take=True) as first,
        connect(near.connect[0], source="second", take=True) as second,
    ):
        await first.set_base_velocity(SPEED)
        await until(lambda: probe.state.velocity.linear_x > SPEED / 2, "the first drives")
        proxy.set(HOLE)
        await until(lambda: probe.state.gate.mode == "idle", "the gate shuts")
        await second.set_base_velocity(0.0)
        await probe.at_rest()
        start = probe.state
        proxy.set()
        async with forging(far) as forger:
            for number in range(COMMANDS):
                command = forged_command(probe, SPEED, 1_000_000 + number, source="first")
                forger.send(CMD_VEL, command)
                if number % AT_ONCE == 0:
                    await second.set_base_velocity(0.0)
                    await asyncio.sleep(0.02)
        await probe.ticks(10)
        if probe.state.gate.commander != "second":
            raise Failed("the second has lost the body")
        states = probe.since(start)[1:]
    return {FIRST_EXECUTED: sum(abs(s.velocity.linear_x) > MOVES for s in states)}


async def viewer_frozen(rig: Rig) -> Measured:
    """Freeze a viewer while a camera sends 1 MB thirty times a second.

    Judged against the same time without either, on the same machine.
    """
    robot = await rig.robot("sim")
    calm_ms, _ = await _filmed(robot, None)
    async with _frozen_viewer(client_endpoint(robot.deployment)):
        period_ms, puts_ms = await _filmed(robot, PICTURE)
    return {
        PERIOD_ADDED: period_ms - calm_ms,
        PUT_P99: percentile(sorted(puts_ms), 0.99) or 0.0,
    }


async def _filmed(robot: RobotUnderTest, picture: Image | None) -> tuple[float, list[float]]:
    """Return control's period (p99) while pictures are sent, and how long each put took [ms]."""
    probe, puts_ms = robot.probe, list[float]()
    await robot.drive()
    start = probe.state
    for _ in range(PICTURES):
        began_s = time.perf_counter()
        if picture:
            probe.bus.publish(IMAGE, picture, name="front")
        puts_ms.append((time.perf_counter() - began_s) * 1e3)
        await asyncio.sleep(PICTURE_S)
    return probe.control_period_ms(start), puts_ms


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
async def _frozen_viewer(endpoint: Endpoint) -> AsyncIterator[None]:
    """Run a process that has subscribed to everything and is frozen."""
    viewer = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-c", VIEWER, msgspec.json.encode(endpoint).decode()),
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert viewer.stdout
        await viewer.stdout.readline()
        await asyncio.sleep(0.2)  # until the others know its subscriptions
        viewer.send_signal(signal.SIGSTOP)
        yield
    finally:
        viewer.kill()
        await viewer.wait()


async def duplicated_and_reordered(rig: Rig) -> Measured:
    """Send everything that drives the robot twice more, in another order."""
    robot = await rig.robot("sim")
    probe = robot.probe
    await robot.drive()
    before, start = await _refused(robot), probe.state
    async with _copies(client_endpoint(robot.deployment)) as sent:
        await probe.ticks(WATCH_TICKS)
    refused = await _refused(robot) - before
    copies = sent.count(CMD_VEL.key)
    if copies < WATCH_TICKS:
        raise Failed(f"only {copies} commands were copied")
    return {COPY_EFFECTS: len(probe.stops(start)) + max(0, copies - refused)}


async def _refused(robot: RobotUnderTest) -> int:
    """Return how many commands the gate has refused, once the driver has published it."""
    await robot.probe.ticks(HEALTH_TICKS)
    counters = robot.probe.health["driver"].counters
    return sum(count for name, count in counters.items() if name.startswith("refused_"))


@asynccontextmanager
async def _copies(endpoint: Endpoint) -> AsyncIterator[list[str]]:
    """Copy each message that arrives for the first time; yields the keys of all copies sent."""
    transport = await ZenohTransport.open(endpoint)
    loop, chance = asyncio.get_running_loop(), random.Random(1)
    seen: set[tuple[str, bytes]] = set()
    sent: list[str] = []
    topics = {topic.key: topic for topic in COPIED}

    def copy(key: str, payload: bytes) -> None:
        transport.publish(topics[key], key, payload, "")
        sent.append(key)

    def on_payload(key: str, payload: bytes) -> None:
        if (key, payload) in seen:
            return
        seen.add((key, payload))
        for _ in range(COPIES):
            timers.append(loop.call_later(SPREAD_S * chance.random(), copy, key, payload))

    timers: list[asyncio.TimerHandle] = []
    closes = [transport.subscribe(key, on_payload, 64) for key in topics]
    try:
        yield sent
    finally:
        for close in closes:
            close()
        await asyncio.sleep(SPREAD_S)
        await transport.close()


ROWS = (
    FaultRow(
        21, two_commanders_across_a_partition, "sim", (FIRST_EXECUTED.at_most(0),), loads=True
    ),
    FaultRow(23, viewer_frozen, "sim", (PERIOD_ADDED.at_most(20), PUT_P99.at_most(20))),
    FaultRow(25, duplicated_and_reordered, "sim", (COPY_EFFECTS.at_most(0),)),
)
