"""Checks of rates and of the way from a command to its bytes."""

import asyncio

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.qa.conformance.result import Failed, Finding
from gigabrain_zenoh.qa.conformance.rig import Rig
from gigabrain_zenoh.qa.conformance.subject import link_of

RATE_TICKS = 70  # 1.4 s
SCAN_TICKS = 350  # a lidar may take so long to turn
OF_TICKS = 0.9  # of the ticks that must bring a state
SCAN_SLACK = 0.25  # of the lidar's rate
OLD_MS = 100.0
SAMPLES = 40
MID_TICK_S = 0.008
MOST_MS = 1.0


async def reports(rig: Rig) -> Finding:
    """A state per tick, fresh; scans as often as the body's file says."""
    lidar = rig.robot.lidar
    if await rig.until(lambda: rig.state and (rig.scan or not lidar), SCAN_TICKS) is None:
        if rig.state and rig.states >= OF_TICKS * SCAN_TICKS:  # so the machine had time
            text = f"no scan within {SCAN_TICKS} ticks, though `lidar:` is in the robot's file"
            return Finding(False, f"{text}; does its link have `scan:`?")
        raise Failed(f"no state and scan within {SCAN_TICKS} ticks")
    assert rig.state
    begin, states, scans, oldest = rig.tick, rig.states, rig.scans, 0.0

    def look() -> bool:
        nonlocal oldest
        assert rig.state
        oldest = max(oldest, rig.state.link.age_ms)
        return False

    await rig.until(look, RATE_TICKS)
    ticks, states, scans = rig.tick - begin, rig.states - states, rig.scans - scans
    late_ms = max((OF_TICKS * ticks - states) * TICK_NS / 1e6, oldest - OLD_MS, 0.0)
    good = late_ms == 0
    text = f"{states} in {ticks} ticks, at most {oldest:.0f} ms old"
    if lidar and rig.scan:
        rate = scans / (ticks * 0.02)
        beams = len(rig.scan.ranges) // 4
        good = good and abs(rate / lidar.rate_hz - 1) <= SCAN_SLACK and beams == lidar.beams
        missing = 1 - rate / ((1 - SCAN_SLACK) * lidar.rate_hz)  # of the time
        late_ms = max(late_ms, missing * ticks * TICK_NS / 1e6)
        text += f"; scans of {beams} beams at {rate:.1f} Hz of {lidar.rate_hz:g}"
    return Finding(good, text, late_ms=late_ms)


async def latency(rig: Rig) -> Finding:
    """From a command on the bus, through the gate and the driver, to its bytes on the line.

    Less what the loop's thread waited for a core in between.
    """
    link, clock = link_of(rig.tap.inner), Clock()
    times: list[float] = []
    asked_ns, waited_ms = 0, 0.0

    def trace(way: str, _: bytes) -> None:
        nonlocal asked_ns
        if way == "tx" and rig.tap.speaking and asked_ns:
            took_ms = (clock.now_ns() - asked_ns) / 1e6
            times.append(took_ms - (this_process.own_waited_ms() - waited_ms))
            asked_ns = 0

    wanted = await rig.drive()
    step = 0.02 * min(rig.robot.max_linear_acceleration, rig.robot.max_linear_deceleration)
    rig.wanted, link.trace = None, trace
    try:
        for i in range(SAMPLES):
            await rig.go_on(1)
            await asyncio.sleep(MID_TICK_S)
            waited_ms = this_process.own_waited_ms()
            asked_ns = clock.now_ns()
            rig.command(Velocity(linear_x=wanted.linear_x - (i % 2) * step))
    finally:
        link.trace = None
    await rig.pause()
    if len(times) < SAMPLES // 2:
        return Finding(False, f"{len(times)} of {SAMPLES} commands led to bytes")
    times.sort()
    p50, p95 = times[len(times) // 2], times[int(len(times) * 0.95)]
    late_ms = sum(max(ms - MOST_MS, 0.0) for ms in times[: len(times) // 2 + 1])
    text = f"p50 {p50:.2f} ms, p95 {p95:.2f} ms of {len(times)}"
    return Finding(p50 <= MOST_MS, text, late_ms=late_ms)
