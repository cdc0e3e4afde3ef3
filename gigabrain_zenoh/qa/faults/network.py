"""Faults of the network: a router that dies or freezes, partitions, delays, copies, damage."""

import asyncio
import functools
import itertools

from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.qa.faults.crowd import (
    duplicated_and_reordered,
    two_commanders_across_a_partition,
    viewer_frozen,
)
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.smooth import starts_and_stops, stops
from gigabrain_zenoh.qa.faults.spoiled import HOLE, behind_proxy
from gigabrain_zenoh.qa.faults.stopping import TICK_MS, creep, stop_by
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.qa.faults.with_keys import bit_flips
from gigabrain_zenoh.qa.proxy.chaos import Chaos
from gigabrain_zenoh.qa.proxy.proxy import TcpProxy
from gigabrain_zenoh.safety.round_trip import SLOWED

__all__ = [
    "bit_flips",
    "duplicated_and_reordered",
    "latency_jitter_loss",
    "network_partition",
    "router_frozen",
    "router_killed",
    "two_commanders_across_a_partition",
    "viewer_frozen",
]

RESTED_TICKS = 50
NO_GAP_TICKS = 5  # up to which the gate waits for a command
FREEZE_S = 2.4  # longer, and the supervisor replaces it
SHORT_HOLE_S, SHORT_HOLES = 0.06, 5  # with 20 ms between commands, a gap of at most 80 ms
HOLES_S, LONG_HOLES_S = (0.3, 1.0, 3.0), (0.15, 0.3, 1.0, 3.0, 30.0)
DRIVE_TICKS = 150  # on each line that is slow, and nothing else
BAD_TICKS = 500  # 10 s on each line that is uneven or lossy
ROUND_TRIPS_MS = (20.0, 50.0, 100.0)
TOO_LONG_MS = 200.0
BAD = (  # on a line that takes 50 ms; each way has half of it
    Chaos(delay_ms=25, jitter_ms=50),
    Chaos(delay_ms=25, loss=0.01),
    Chaos(delay_ms=25, loss=0.05),
    Chaos(delay_ms=25, loss=0.2),
)


async def router_killed(rig: Rig) -> Measured:
    """kill -9; nobody hears anybody until it is back."""
    subject = await rig.robot("sim")
    onlooker, loop = subject.onlooker, asyncio.get_running_loop()
    await subject.drive()
    start, said = onlooker.state, len(subject.records)
    pid = subject.kill("router")
    await subject.restarted("router", pid)
    back_s = loop.time()
    await until(lambda: onlooker.state.tick > start.tick + NO_GAP_TICKS, "the robot is heard again")
    heard_s = loop.time() - back_s
    stopped = _stopped_tick(subject, said)
    await onlooker.still()
    return {
        "brakes after": (stopped - _newest_command(subject, start)) * TICK_MS,
        "session after": heard_s,
        "moved again": await creep(subject, RESTED_TICKS),
    }


def _stopped_tick(subject: Subject, since: int) -> int:
    """The tick in which the gate began to stop, by the driver's own log. Raises Failed."""
    for record in subject.records[since:]:
        if record.get("event") == "gate" and record.get("mode") == "stopping":
            return int(record["tick"])
    raise Failed("the gate did not stop while the router was away")


def _newest_command(subject: Subject, start: RobotState) -> int:
    """The tick that the last command has echoed before the fault, or that of the fault."""
    commands = (c.tick for c in reversed(subject.onlooker.commands) if c.boot == start.boot)
    return max(start.tick, next((tick for tick in commands if tick <= start.tick + 1), 0))


async def router_frozen(rig: Rig) -> Measured:
    """SIGSTOP for some seconds: what the kernels hold comes all at once when it goes on."""
    subject = await rig.robot("sim")
    onlooker = subject.onlooker
    await subject.drive()
    before, start = await _stale(subject), onlooker.state
    subject.freeze("router")
    await asyncio.sleep(FREEZE_S)
    subject.thaw()
    long_ticks = round(FREEZE_S * 1e3 / TICK_MS / 2)
    await until(lambda: onlooker.state.tick > start.tick + long_ticks, "the robot is heard again")
    await onlooker.still()
    again_m = await creep(subject, RESTED_TICKS)
    return {"stale executed": await _stale(subject) - before, "moved again": again_m}


async def _stale(subject: Subject) -> float:
    """Commands that the driver obeyed though they were too old, since it started."""
    report = (await subject.onlooker.describe("driver")).report
    return float(report["stale_commands_executed"] or 0)


async def network_partition(rig: Rig) -> Measured:
    """A hole between the whole brain and the body, shorter and longer than the gate waits."""
    async with behind_proxy(rig, "perception", "decision", "control") as (subject, proxy):
        holes = [await _short_hole(subject, proxy) for _ in range(SHORT_HOLES)]
        short = [stopped for gap, stopped in holes if gap <= NO_GAP_TICKS]
        if not short:
            raise Failed(f"no gap of 100 ms: {', '.join(str(gap) for gap, _ in holes)} ticks")
        worst_ms = again_m = 0.0
        for hole_s in LONG_HOLES_S if rig.long else HOLES_S:
            stop = await stop_by(subject, functools.partial(_hole, proxy, hole_s), "control")
            await asyncio.sleep(hole_s)
            await subject.onlooker.ticks(RESTED_TICKS)
            worst_ms = max(worst_ms, stop.brakes_ms)
            again_m = max(again_m, await subject.distance() - stop.distance_m)
        stale = await _stale(subject)
    return {
        "stops in a gap of 100 ms": sum(short),
        "brakes after": worst_ms,
        "stale executed": stale,
        "moved again": again_m,
    }


def _hole(proxy: TcpProxy, seconds: float) -> None:
    proxy.set(HOLE)
    asyncio.get_running_loop().call_later(seconds, proxy.set)


async def _short_hole(subject: Subject, proxy: TcpProxy) -> tuple[int, bool]:
    """Return the longest gap between two commands [ticks], and whether the robot stopped."""
    onlooker = subject.onlooker
    await subject.drive()
    start = onlooker.state
    _hole(proxy, SHORT_HOLE_S)
    await onlooker.ticks(2 * NO_GAP_TICKS)
    gap = max(b - a for a, b in itertools.pairwise(t for t in onlooker.arrivals if t >= start.tick))
    return gap, bool(stops(onlooker, start))


async def latency_jitter_loss(rig: Rig) -> Measured:
    """Control on the far side of a slow, uneven and lossy line."""
    async with behind_proxy(rig, "control", resume="auto") as (subject, proxy):
        stopped = 0
        for round_trip_ms in ROUND_TRIPS_MS:
            proxy.set(Chaos(delay_ms=round_trip_ms / 2))
            stopped += await _stops(subject)
        rate_hz = 0.0
        for chaos in BAD:
            proxy.set(chaos)
            rate_hz = max(rate_hz, await _start_stop_rate_hz(subject))
        proxy.set(Chaos(delay_ms=TOO_LONG_MS / 2))
        await subject.onlooker.still()
        moved_m = await creep(subject, RESTED_TICKS)
    return {
        "stops at 100 ms round trip": stopped,
        "moves above 150 ms": float(moved_m > 0.005),
        "start-stop rate": rate_hz,
    }


async def _stops(subject: Subject) -> int:
    """Return how often it stopped within three seconds of its time."""
    onlooker = subject.onlooker
    await subject.drive(share=SLOWED)  # a line of 100 ms and what this machine adds are too long
    start = onlooker.state
    await onlooker.ticks(DRIVE_TICKS)
    return len(stops(onlooker, start))


async def _start_stop_rate_hz(subject: Subject) -> float:
    """Return how many starts and stops there are in a second of the robot's time."""
    start = subject.onlooker.state
    await subject.onlooker.ticks(BAD_TICKS)
    changes = starts_and_stops(subject.onlooker, start, BAD_TICKS)
    return changes / (BAD_TICKS * TICK_MS / 1e3)
