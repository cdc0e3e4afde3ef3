"""Checks behind the gate: stops on silence, disorder and a dead commander; rates and latency."""

import asyncio
import contextlib
import logging
import math
import os
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import msgspec

from gigabrain_schemas.base import TICK_MS, TICK_NS, TICK_S, Velocity
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.qa.conformance.driver_checks import CheckedRobot, DriverSession, link_of
from gigabrain_zenoh.qa.conformance.gated_driver import (
    ATTEMPTS,
    SPEED_SHARE,
    GatedDriver,
    stop_ticks,
)
from gigabrain_zenoh.qa.judging import Failed, Finding, Skipped
from gigabrain_zenoh.qa.probe import until

SILENCE_TICKS = 7  # 100 ms without a command, applied in the next tick
AT_ONCE_TICKS = 2
DISORDER_TICKS = 35
LATE_TICKS = 100  # a body that still moves is watched this long, to measure its delay
COMMANDER = "import time\nwhile True:\n print(flush=True)\n time.sleep(0.02)\n"


RATE_TICKS = 70  # 1.4 s
SCAN_TICKS = 350  # a lidar may take so long to turn
MIN_SHARE_OF_TICKS = 0.9  # of the ticks that must bring a state
SCAN_SLACK = 0.25  # of the lidar's rate
MAX_AGE_MS = 100.0
SAMPLES = 40
MID_TICK_S = 0.008
MAX_LATENCY_MS = 1.0
UNPLUGGED_MS = 100.0  # until the gate reports a cut line
FROZEN_MS = 250.0  # until it reports a frozen peer
SLACK_MS = 100.0  # added to these, for a shared machine
NOTICED_TICKS = 12  # until the gate reports a loss, if that is not judged
BACK_TICKS = 250
QUIET_TICKS = 15
START_S = 20.0  # for a driver in its own process, on a busy machine
REPORTED, ZEROED, RESTS = "reported", "motors at zero", "at rest"  # since the fault


async def silence(gated: GatedDriver) -> Finding:
    """Stop commanding at full speed."""
    await gated.drive()
    gated.wanted = None
    return await _stopped(gated, stop_ticks(gated, SILENCE_TICKS))


async def not_a_number(gated: GatedDriver) -> Finding:
    """Command NaN: the gate sends zero at once, without a ramp."""
    await gated.drive()
    gated.wanted = None
    last, calls = gated.last, len(gated.tap.asked)
    if last is None:
        raise Failed("nothing was commanded")
    with _silenced("gigabrain_zenoh.bus.bus"):
        gated.deliver({**msgspec.structs.asdict(last), "linear_x": math.nan, "seq": last.seq + 1})
        in_time = await gated.until(lambda: gated.tap.asked[calls:], AT_ONCE_TICKS)
    zero = in_time is not None and gated.tap.asked[calls] == ZERO
    found = await _stopped(gated, stop_ticks(gated, AT_ONCE_TICKS))
    text = "zero at once" if zero else "not zero at once"
    return Finding(found.ok and zero, f"{text}; {found.measured}")


@contextlib.contextmanager
def _silenced(name: str) -> Iterator[None]:
    """Silence a logger while the kit sends bad messages on purpose."""
    logger = logging.getLogger(name)
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = False


async def disorder(gated: GatedDriver) -> Finding:
    """Send old, duplicated and reordered commands: none is obeyed or keeps the gate open."""
    wanted = await gated.drive()
    earlier = gated.last
    await gated.run_for(12)
    gated.wanted, last, calls = None, gated.last, len(gated.tap.asked)
    if earlier is None or last is None:
        raise Failed("nothing was commanded")
    before, end = sum(gated.refused.values()), gated.tick + DISORDER_TICKS
    back = -wanted.linear_x
    replace = msgspec.structs.replace
    at_rest: int | None = None
    begin = gated.tick
    most = stop_ticks(gated, SILENCE_TICKS)
    while gated.tick < end or (at_rest is None and gated.tick < begin + most + LATE_TICKS):
        gated.deliver(replace(last, linear_x=back))  # a duplicate
        gated.deliver(replace(last, linear_x=back, seq=last.seq - 3))  # overtaken
        gated.deliver(replace(earlier, linear_x=back, seq=last.seq + 100))  # old, with a new number
        gated.deliver(replace(last, linear_x=back, seq=last.seq + 200, tick=gated.tick + 1000))
        if at_rest is None and gated.rests:
            at_rest = gated.tick - begin
        await gated.run_for(1)
    refused = sum(gated.refused.values()) - before
    backward = sum(1 for asked in gated.tap.asked[calls:] if asked.linear_x * back > 0)
    text = f"{refused} refused, {backward} obeyed; "
    if at_rest is None:
        return Finding(False, text + "never at rest")
    late_ms = 0.0 if backward else max((at_rest - most) * TICK_MS, 0.0)
    good = backward == 0 and at_rest <= most
    return Finding(good, f"{text}at rest after {at_rest} ticks", late_ms=late_ms)


async def killed(gated: GatedDriver) -> Finding:
    """Kill a commander that is a process, by SIGKILL."""
    for _ in range(ATTEMPTS):
        await gated.drive()
        async with _commander(gated):
            if await gated.until(lambda: gated.wanted is None, 250) is None:
                raise Failed("the commander's process did not start")
            await gated.run_for(15)
            obeyed = gated.mode == "enabled"
        if obeyed:
            return await _stopped(gated, stop_ticks(gated, SILENCE_TICKS))
    raise Failed(f"the commander's process was not obeyed; gate {gated.mode}")


@contextlib.asynccontextmanager
async def _commander(gated: GatedDriver) -> AsyncIterator[None]:
    """Run a process that takes over the commands; it is killed at the end."""
    commander = await asyncio.create_subprocess_exec(
        sys.executable, "-S", "-c", COMMANDER, stdout=asyncio.subprocess.PIPE
    )
    relay = asyncio.create_task(_relay(gated, commander))
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):  # it has ended by itself
            commander.kill()
        relay.cancel()
        await asyncio.gather(commander.wait(), relay, return_exceptions=True)


async def _relay(gated: GatedDriver, commander: asyncio.subprocess.Process) -> None:
    """Command once per line of the commander's output; the first line takes over."""
    assert commander.stdout
    velocity = gated.wanted or ZERO
    while await commander.stdout.readline():
        gated.wanted = None
        gated.command(velocity)


async def _stopped(gated: GatedDriver, most: int) -> Finding:
    ticks = await gated.until(lambda: gated.rests, most + LATE_TICKS)
    if ticks is None:
        return Finding(False, f"still moving after {most + LATE_TICKS} ticks of at most {most}")
    text, late_ms = f"at rest after {ticks} ticks of at most {most}", (ticks - most) * TICK_MS
    return Finding(ticks <= most, text, {"at rest": ticks * TICK_MS}, max(late_ms, 0.0))


async def reports(gated: GatedDriver) -> Finding:
    """Check for a fresh state per tick, and for scans at the rate of the robot's file."""
    lidar = gated.robot.lidar
    if await gated.until(lambda: gated.state and (gated.scan or not lidar), SCAN_TICKS) is None:
        if gated.state and gated.states >= MIN_SHARE_OF_TICKS * SCAN_TICKS:
            text = f"no scan within {SCAN_TICKS} ticks, though `lidar:` is in the robot's file"
            return Finding(False, f"{text}; does its link have `scan:`?")
        raise Failed(f"no state and scan within {SCAN_TICKS} ticks")
    assert gated.state
    begin, states, scans, oldest = gated.tick, gated.states, gated.scans, 0.0

    def track_age() -> bool:
        nonlocal oldest
        assert gated.state
        oldest = max(oldest, gated.state.link.age_ms)
        return False

    await gated.until(track_age, RATE_TICKS)
    ticks, states, scans = gated.tick - begin, gated.states - states, gated.scans - scans
    late_ms = max((MIN_SHARE_OF_TICKS * ticks - states) * TICK_NS / 1e6, oldest - MAX_AGE_MS, 0.0)
    good = late_ms == 0
    text = f"{states} in {ticks} ticks, at most {oldest:.0f} ms old"
    if lidar and gated.scan:
        rate = scans / (ticks * TICK_S)
        beams = len(gated.scan.ranges) // 4
        good = good and abs(rate / lidar.rate_hz - 1) <= SCAN_SLACK and beams == lidar.beams
        missing = 1 - rate / ((1 - SCAN_SLACK) * lidar.rate_hz)  # of the time
        late_ms = max(late_ms, missing * ticks * TICK_NS / 1e6)
        text += f"; scans of {beams} beams at {rate:.1f} Hz of {lidar.rate_hz:g}"
    return Finding(good, text, late_ms=late_ms)


async def latency(gated: GatedDriver) -> Finding:
    """Measure from a command on the bus, through gate and driver, to its bytes on the line.

    The time for which the loop's thread waited for a core is subtracted.
    """
    link, clock = link_of(gated.tap.driver), Clock()
    times: list[float] = []
    asked_ns, waited_ms = 0, 0.0

    def trace(way: str, _: bytes) -> None:
        nonlocal asked_ns
        if way == "tx" and gated.tap.sending and asked_ns:
            took_ms = (clock.now_ns() - asked_ns) / 1e6
            times.append(took_ms - (this_process.own_waited_ms() - waited_ms))
            asked_ns = 0

    wanted = await gated.drive()
    step = TICK_S * min(gated.robot.max_linear_acceleration, gated.robot.max_linear_deceleration)
    gated.wanted, link.trace = None, trace
    try:
        for i in range(SAMPLES):
            await gated.run_for(1)
            await asyncio.sleep(MID_TICK_S)
            waited_ms = this_process.own_waited_ms()
            asked_ns = clock.now_ns()
            gated.command(Velocity(linear_x=wanted.linear_x - (i % 2) * step))
    finally:
        link.trace = None
    await gated.pause()
    if len(times) < SAMPLES // 2:
        return Finding(False, f"{len(times)} of {SAMPLES} commands led to bytes")
    times.sort()
    p50, p95 = times[len(times) // 2], times[int(len(times) * 0.95)]
    late_ms = sum(max(ms - MAX_LATENCY_MS, 0.0) for ms in times[: len(times) // 2 + 1])
    text = f"p50 {p50:.2f} ms, p95 {p95:.2f} ms of {len(times)}"
    return Finding(p50 <= MAX_LATENCY_MS, text, late_ms=late_ms)


async def unplugged(gated: GatedDriver) -> Finding:
    """Cut the line at full speed: the gate reports it, and the body stops by itself."""
    return await _cut(gated, "unplugged", UNPLUGGED_MS)


async def frozen(gated: GatedDriver) -> Finding:
    """Freeze the peer with its line open."""
    return await _cut(gated, "frozen", FROZEN_MS)


async def reconnects(gated: GatedDriver) -> Finding:
    """Mend the line: it reconnects by itself, and nothing old moves the body."""
    await gated.drive()
    gated.checked.break_peer("unplugged")
    try:
        if await gated.until(lambda: "link_lost" in gated.causes, NOTICED_TICKS) is None:
            raise Failed("the loss was not noticed")
        # before it stands: only old bytes could move it afterwards
        ticks = gated.checked.goes_on or await gated.until(lambda: gated.rests, _rest_ticks(gated))
        if ticks is None:
            raise Failed("the body did not stop by itself")
    finally:
        gated.checked.break_peer("")
    back = await gated.until(lambda: gated.state and gated.state.link.connected, BACK_TICKS)
    if back is None:
        raise Failed(f"not back after {BACK_TICKS} ticks")
    if gated.checked.goes_on:
        await _until_stopped(gated)
    moved = await gated.until(lambda: any(gated.checked.commanded(gated.state)), QUIET_TICKS)
    reconnects = gated.state.link.reconnects if gated.state else 0
    await gated.drive()
    await gated.pause()
    old = "nothing moved it" if moved is None else "it moved before it was enabled"
    return Finding(
        moved is None and reconnects > 0, f"after {back} ticks, reconnects {reconnects}; {old}"
    )


async def driver_killed(robot: CheckedRobot) -> Finding:
    """Kill the driver by SIGKILL: the body stops by its own watchdog, or the driver's guard."""
    guard_ms = robot.driver().guard_ms
    if robot.goes_on and guard_ms is None:
        raise Skipped(
            f"motors at zero {robot.promise}: they keep turning until a driver starts again"
        )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    child = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", __name__),
        *(robot.name, str(robot.folder), str(robot.next_direction())),
        env=environment,
    )
    loop = asyncio.get_running_loop()

    def drives_or_ended() -> bool:
        return child.returncode is not None or any(robot.commanded(None))

    try:
        await until(drives_or_ended, "the driver drives", START_S)
        if child.returncode is not None:
            raise Failed(f"the driver ended with exit code {child.returncode} before it drove")
        await asyncio.sleep(0.3)
        begin = loop.time()
    finally:
        with contextlib.suppress(ProcessLookupError):  # it has ended by itself
            child.kill()
        await child.wait()
    await until(lambda: not any(robot.commanded(None)), "the motors stop", 2.0)
    took = (loop.time() - begin) * 1e3
    late = took - (guard_ms or robot.promised_ms) - SLACK_MS
    text = f"{ZEROED} after {took:.0f} ms{', by its guard' if guard_ms else ''}"
    return Finding(late <= 0, text, {ZEROED: took}, max(late, 0.0))


def _rest_ticks(gated: GatedDriver) -> int:
    """Return the number of ticks in which the body must stop by itself."""
    return stop_ticks(gated, round((gated.checked.promised_ms + SLACK_MS) * 1e6 / TICK_NS))


async def _until_stopped(gated: GatedDriver) -> None:
    """Wait until the driver has stopped motors that have no watchdog. Raises Failed."""

    def stopped() -> bool:
        return not any(gated.checked.commanded(gated.state))

    if await gated.until(stopped, QUIET_TICKS) is None:
        raise Failed("connected again, but the motors keep turning")


async def _cut_off(gated: GatedDriver, fault: str, reported_ms: float) -> Finding:
    """Cut the line to motors without a watchdog: it is reported, and stops them once it is back."""
    await gated.drive()
    gated.checked.break_peer(fault)
    try:
        times = await gated.firsts({REPORTED: lambda: "link_lost" in gated.causes}, NOTICED_TICKS)
        gated.wanted = None
        await gated.run_for(QUIET_TICKS)
    finally:
        gated.checked.break_peer("")
    if await gated.until(lambda: gated.state and gated.state.link.connected, BACK_TICKS) is None:
        raise Failed(f"not received again after {BACK_TICKS} ticks")
    await _until_stopped(gated)
    late = times.get(REPORTED, math.inf) - reported_ms - SLACK_MS
    text = f"{REPORTED} after {times[REPORTED]:.0f} ms" if times else f"never {REPORTED}"
    text += "; motors without a watchdog keep turning until the line is back"
    return Finding(late <= 0, text, times, max(late, 0.0) if math.isfinite(late) else 0.0)


async def _cut(gated: GatedDriver, fault: str, reported_ms: float) -> Finding:
    if gated.checked.goes_on:
        return await _cut_off(gated, fault, reported_ms)
    await gated.drive()
    gated.checked.break_peer(fault)
    try:
        times = await gated.firsts(
            {
                REPORTED: lambda: "link_lost" in gated.causes,
                ZEROED: lambda: not any(gated.checked.commanded(gated.state)),
                RESTS: lambda: gated.rests,
            },
            _rest_ticks(gated) + LATE_TICKS,
        )
        gated.wanted = None
        await gated.run_for(QUIET_TICKS)
    finally:
        gated.checked.break_peer("")
    thawed = await gated.until(lambda: any(gated.checked.commanded(gated.state)), QUIET_TICKS)
    if await gated.until(lambda: gated.state and gated.state.link.connected, BACK_TICKS) is None:
        raise Failed(f"not received again after {BACK_TICKS} ticks")
    limits = {
        REPORTED: reported_ms + SLACK_MS,
        ZEROED: gated.checked.promised_ms + SLACK_MS,
        RESTS: _rest_ticks(gated) * TICK_NS / 1e6,
    }
    late = max(times.get(name, math.inf) - most for name, most in limits.items())
    texts = [f"{n} after {times[n]:.0f} ms" if n in times else f"never {n}" for n in limits]
    again = "; then old commands moved it" if thawed is not None else ""
    missed = late if math.isfinite(late) and not again else 0.0
    return Finding(late <= 0 and not again, ", ".join(texts) + again, times, max(missed, 0.0))


async def drive_until_killed(name: str, folder: Path, way: int) -> None:
    """Drive at half speed until the process is killed."""
    robot = CheckedRobot(name, "emulated", folder)
    async with DriverSession(robot) as it:
        await it.connected()
        it.wanted = Velocity(linear_x=way * SPEED_SHARE * robot.file.max_linear_speed)
        while True:
            await it.run_for(50)


if __name__ == "__main__":
    logging.getLogger().addHandler(logging.NullHandler())  # the kit itself causes the warnings
    asyncio.run(drive_until_killed(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])))
