"""Faults of the network: a dead or frozen router, partitions, delays, losses, flipped bits."""

import asyncio
import contextlib
import functools
import itertools
import random
import signal
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from gigabrain_schemas.base import TICK_MS
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Twist
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import (
    CMD_VEL,
    IMAGE,
    INTENT,
    SAFETY,
    SCAN,
    STATE,
    TELEOP,
    WORLD,
    Role,
)
from gigabrain_zenoh.bus.zenoh.config import secured
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.client.connection import connect
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.launch.deployment import Deployment, with_free_port
from gigabrain_zenoh.launch.processes import names_by_role
from gigabrain_zenoh.qa.faults import cpu_load
from gigabrain_zenoh.qa.faults.cpu_load import endpoint_text
from gigabrain_zenoh.qa.faults.rig import (
    BRAKES,
    HOLE,
    MOVED_AGAIN,
    NONE_STALE,
    PERIOD_ADDED,
    RESTED_TICKS,
    STALE,
    STAYS_STILL,
    Rig,
    address_of,
    behind_proxy,
    forged_command,
    forging,
    proxy_to,
    stop_by,
)
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, fault_row
from gigabrain_zenoh.qa.probe import PATIENCE_S, until
from gigabrain_zenoh.qa.proxy.chaos import Chaos
from gigabrain_zenoh.qa.proxy.tcp import TcpProxy
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.safety.health import HALF_SPEED
from gigabrain_zenoh.security.authority import issue, new_fleet

NO_GAP_TICKS = 5  # for which the gate waits for a command
FREEZE_S = 2.4  # after a longer freeze the supervisor replaces the router
SHORT_HOLE_S, SHORT_HOLES = 0.06, 5  # with 20 ms between commands, a gap of at most 80 ms
HOLES_S, LONG_HOLES_S = (0.3, 1.0, 3.0), (0.15, 0.3, 1.0, 3.0, 30.0)
DRIVE_TICKS = 150  # on each line that is only slow
BAD_TICKS = 500  # 10 s on each line that is uneven or lossy
ROUND_TRIPS_MS = (20.0, 50.0, 100.0)
TOO_LONG_MS = 200.0
BAD_LINES = (  # with a round trip of 50 ms; each way has half of it
    Chaos(delay_ms=25, jitter_ms=50),
    Chaos(delay_ms=25, loss=0.01),
    Chaos(delay_ms=25, loss=0.05),
    Chaos(delay_ms=25, loss=0.2),
)
MOVES_M = 0.005
ROLES: tuple[Role, ...] = ("robot", "brain", "operator", "viewer")
FLIPS = (1e-4, 1e-3)  # of each byte
FLIP_S, LONG_FLIP_S = 6.0, 60.0
PUT_S = 0.005

SESSION = Figure("session after", "s", wall=True)
STOPS_IN_GAP = Figure("stops in a gap of 100 ms")
STOPS_IF_SLOW = Figure("stops at 100 ms round trip")
MOVES_IF_TOO_SLOW = Figure("moves above 150 ms")
START_STOP_RATE = Figure("start-stop rate", "Hz")
CORRUPT_ACCEPTED = Figure("corrupt payloads accepted")


COMMANDS, AT_ONCE = 10_000, 40
SPEED, MOVES = 0.1, 0.02  # [m/s]
PICTURE = Image(frame_id="camera", encoding="mono8", height=1000, width=1000, data=bytes(1_000_000))
PICTURES, PICTURE_S = 120, 1 / 30
COPIES, SPREAD_S = 2, 0.1
COPIED = (SCAN, STATE, WORLD, INTENT, CMD_VEL, SAFETY)
WATCH_TICKS = 250
HEALTH_TICKS = 75  # until the driver has published its counters
FIRST_EXECUTED = Figure("commands of the first executed")
PUT_P99 = Figure("put p99", "ms", wall=True)
COPY_EFFECTS = Figure("effects beyond the first copy")


@fault_row(18, "sim", BRAKES.at_most(120), SESSION.at_most(3), STAYS_STILL)
async def router_killed(rig: Rig) -> Measured:
    """Kill the router: no message arrives until it is back."""
    robot = await rig.robot("sim")
    probe, loop = robot.probe, asyncio.get_running_loop()
    await robot.until_driving()
    start, records = probe.state, len(robot.records)
    pid = robot.kill("router")
    await robot.until_restarted("router", pid)
    back_s = loop.time()
    await until(lambda: probe.state.tick > start.tick + NO_GAP_TICKS, "the robot is received again")
    session_s = loop.time() - back_s
    stopped = _stopped_tick(robot, records)
    await probe.at_rest()
    return {
        BRAKES: (stopped - _newest_command(robot, start)) * TICK_MS,
        SESSION: session_s,
        MOVED_AGAIN: await robot.travel_within(RESTED_TICKS),
    }


def _stopped_tick(robot: RobotUnderTest, since: int) -> int:
    """Return the tick in which the gate began to stop, by the driver's own log. Raises Failed."""
    for record in robot.records[since:]:
        if record.get("event") == "gate" and record.get("mode") == "stopping":
            return int(record["tick"])
    raise Failed("the gate did not stop while the router was away")


def _newest_command(robot: RobotUnderTest, start: RobotState) -> int:
    """Return the tick that the last command before the fault has echoed, or that of the fault."""
    commands = (c.tick for c in reversed(robot.probe.commands) if c.boot == start.boot)
    return max(start.tick, next((tick for tick in commands if tick <= start.tick + 1), 0))


@fault_row(19, "sim", NONE_STALE, STAYS_STILL)
async def router_frozen(rig: Rig) -> Measured:
    """Freeze the router for seconds: what the kernels hold comes all at once afterwards."""
    robot = await rig.robot("sim")
    probe = robot.probe
    await robot.until_driving()
    before, start = await _stale(robot), probe.state
    robot.freeze("router")
    await asyncio.sleep(FREEZE_S)
    robot.thaw()
    long_ticks = round(FREEZE_S * 1e3 / TICK_MS / 2)
    await until(lambda: probe.state.tick > start.tick + long_ticks, "the robot is received again")
    await probe.at_rest()
    again_m = await robot.travel_within(RESTED_TICKS)
    return {STALE: await _stale(robot) - before, MOVED_AGAIN: again_m}


async def _stale(robot: RobotUnderTest) -> float:
    """Return how many commands the driver has obeyed that were too old, since it started."""
    return float((await robot.probe.truth())["stale_commands_executed"] or 0)


@fault_row(20, "", STOPS_IN_GAP.at_most(0), BRAKES.at_most(120), NONE_STALE, STAYS_STILL)
async def network_partition(rig: Rig) -> Measured:
    """Cut the brain off from the body, for shorter and for longer than the gate waits."""
    async with behind_proxy(rig, "perception", "decision", "control") as (robot, proxy):
        holes = [await _short_hole(robot, proxy) for _ in range(SHORT_HOLES)]
        short = [stopped for gap, stopped in holes if gap <= NO_GAP_TICKS]
        if not short:
            raise Failed(f"no gap of 100 ms: {', '.join(str(gap) for gap, _ in holes)} ticks")
        worst_ms = again_m = 0.0
        for hole_s in LONG_HOLES_S if rig.long else HOLES_S:
            stop = await stop_by(robot, functools.partial(_cut_off, proxy, hole_s), "control")
            await asyncio.sleep(hole_s)
            await robot.probe.ticks(RESTED_TICKS)
            worst_ms = max(worst_ms, stop.brakes_ms)
            again_m = max(again_m, await robot.travelled() - stop.distance_m)
        stale = await _stale(robot)
    return {STOPS_IN_GAP: sum(short), BRAKES: worst_ms, STALE: stale, MOVED_AGAIN: again_m}


def _cut_off(proxy: TcpProxy, seconds: float) -> None:
    proxy.set(HOLE)
    asyncio.get_running_loop().call_later(seconds, proxy.set)


async def _short_hole(robot: RobotUnderTest, proxy: TcpProxy) -> tuple[int, bool]:
    """Return the longest gap between two commands [ticks], and whether the robot stopped."""
    probe = robot.probe
    await robot.until_driving()
    start = probe.state
    _cut_off(proxy, SHORT_HOLE_S)
    await probe.ticks(2 * NO_GAP_TICKS)
    gap = max(b - a for a, b in itertools.pairwise(t for t in probe.arrivals if t >= start.tick))
    return gap, bool(probe.stops(start))


@fault_row(
    22, "", STOPS_IF_SLOW.at_most(0), MOVES_IF_TOO_SLOW.at_most(0), START_STOP_RATE.at_most(1)
)
async def latency_jitter_loss(rig: Rig) -> Measured:
    """Put control at the far end of a slow, uneven and lossy line."""
    async with behind_proxy(rig, "control", resume="auto") as (robot, proxy):
        probe, stopped, rate_hz = robot.probe, 0, 0.0
        for round_trip_ms in ROUND_TRIPS_MS:
            proxy.set(Chaos(delay_ms=round_trip_ms / 2))
            await robot.until_driving(
                share=HALF_SPEED
            )  # 100 ms and what this machine adds are too long
            start = probe.state
            await probe.ticks(DRIVE_TICKS)
            stopped += len(probe.stops(start))
        for chaos in BAD_LINES:
            proxy.set(chaos)
            start = probe.state
            await probe.ticks(BAD_TICKS)
            changes = probe.starts_and_stops(start, BAD_TICKS)
            rate_hz = max(rate_hz, changes / (BAD_TICKS * TICK_MS / 1e3))
        proxy.set(Chaos(delay_ms=TOO_LONG_MS / 2))
        await probe.at_rest()
        moved_m = await robot.travel_within(RESTED_TICKS)
    return {
        STOPS_IF_SLOW: stopped,
        MOVES_IF_TOO_SLOW: float(moved_m > MOVES_M),
        START_STOP_RATE: rate_hz,
    }


@fault_row(24, "", CORRUPT_ACCEPTED.at_most(0), needs=("keys",))
async def bit_flips(rig: Rig) -> Measured:
    """Flip bits between an operator and the router; a viewer must receive only what was sent.

    With keys the link is closed and opened again. Without them the damage goes unnoticed: of 2135
    messages that came through the same damage, 102 were damaged, and 15 of those still valid.
    """
    fleet = make_fleet(rig.fresh_folder() / "fleet")
    async with _operator_and_viewer(fleet) as (proxy, operator, viewer):
        received: list[bytes] = []
        viewer.subscribe(TELEOP.key, lambda _key, payload: received.append(payload), 256)
        sent: set[bytes] = set()
        await _send_until_received(operator, sent, received)
        for chance in FLIPS:
            proxy.set(Chaos(corrupt=chance))
            for _ in range(round((LONG_FLIP_S if rig.long else FLIP_S) / PUT_S)):
                _send_new(operator, sent)
                await asyncio.sleep(PUT_S)
        flipped = sum(figures.flipped for figures in proxy.figures.values())
        proxy.set()
        await _send_until_received(operator, sent, received)
    if not flipped:
        raise Failed("no bit was flipped")
    return {CORRUPT_ACCEPTED: sum(payload not in sent for payload in received)}


def _send_new(operator: ZenohTransport, sent: set[bytes]) -> None:
    """Send a message that has not been sent before."""
    payload = encode(Twist(linear_x=0.0, seq=len(sent), stamp_ns=len(sent) * 7919))
    sent.add(payload)
    operator.publish(TELEOP, TELEOP.key, payload, "")


async def _send_until_received(
    operator: ZenohTransport, sent: set[bytes], received: list[bytes]
) -> None:
    """Send until the next message arrives. Raises TimeoutError."""
    before = len(received)
    async with asyncio.timeout(PATIENCE_S):
        while len(received) == before:
            _send_new(operator, sent)
            await asyncio.sleep(PUT_S)


@asynccontextmanager
async def _operator_and_viewer(
    fleet: Path,
) -> AsyncIterator[tuple[TcpProxy, ZenohTransport, ZenohTransport]]:
    """Open a router with keys, an operator behind a proxy, and a viewer without one."""
    router = with_free_port(Deployment(body="mock", router="tcp/127.0.0.1:0")).router
    async with contextlib.AsyncExitStack() as stack:

        async def join(role: Role, connect: str = "", listen: str = "") -> ZenohTransport:
            here = (listen,) if listen else ()
            there = (connect,) if connect else ()
            keys, names = str(fleet / role), names_by_role() if listen else {}
            endpoint = Endpoint(connect=there, listen=here, keys=keys, names=names)
            transport = await ZenohTransport.open(secured(endpoint))
            stack.push_async_callback(transport.close)
            return transport

        await join("robot", listen=router)
        proxy = await stack.enter_async_context(TcpProxy(address_of(Endpoint(connect=(router,)))))
        operator = await join("operator", proxy.endpoint)
        yield proxy, operator, await join("viewer", router)
        proxy.set()


def make_fleet(folder: Path) -> Path:
    """Make the keys of a robot and of all roles."""
    new_fleet("faults", folder)
    for role in ROLES:
        issue(folder, role)
    return folder


@fault_row(21, "sim", FIRST_EXECUTED.at_most(0), loads=True)
async def two_commanders_across_a_partition(rig: Rig) -> Measured:
    """Cut the first commander off while it drives, let the second take over, heal the network."""
    robot = await rig.robot("sim")
    probe, near = robot.probe, robot.endpoint
    await robot.until_driving()  # all is well, and a client may take over
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


@fault_row(23, "sim", PERIOD_ADDED.at_most(20), PUT_P99.at_most(20))
async def viewer_frozen(rig: Rig) -> Measured:
    """Freeze a viewer while a camera sends 1 MB thirty times a second.

    Judged against the same time without either, on the same machine.
    """
    robot = await rig.robot("sim")
    calm_ms, _ = await _filmed(robot, None)
    async with cpu_load.running("view", endpoint_text(robot.endpoint)) as viewer:
        assert viewer.stdout
        await viewer.stdout.readline()
        await asyncio.sleep(0.2)  # until the others know its subscriptions
        viewer.send_signal(signal.SIGSTOP)
        period_ms, puts_ms = await _filmed(robot, PICTURE)
    return {
        PERIOD_ADDED: period_ms - calm_ms,
        PUT_P99: percentile(sorted(puts_ms), 0.99) or 0.0,
    }


async def _filmed(robot: RobotUnderTest, picture: Image | None) -> tuple[float, list[float]]:
    """Return control's period (p99) while pictures are sent, and how long each put took [ms]."""
    probe, puts_ms = robot.probe, list[float]()
    await robot.until_driving()
    start = probe.state
    for _ in range(PICTURES):
        began_s = time.perf_counter()
        if picture:
            probe.bus.publish(IMAGE, picture, name="front")
        puts_ms.append((time.perf_counter() - began_s) * 1e3)
        await asyncio.sleep(PICTURE_S)
    return probe.control_period_ms(start), puts_ms


@fault_row(25, "sim", COPY_EFFECTS.at_most(0))
async def duplicated_and_reordered(rig: Rig) -> Measured:
    """Send everything that drives the robot twice more, in another order."""
    robot = await rig.robot("sim")
    probe = robot.probe
    await robot.until_driving()
    before, start = await _refused(robot), probe.state
    async with _copies(robot.endpoint) as sent:
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
